#!/bin/sh
# Builds OpenSSL, SQLite and Python of Debian's sources in the root of `python -m
# appliance.packaging.root`, and installs them to its /usr/local. `optimized` as the argument: Python
# with a profile of its own test runs (PGO and LTO), which takes many times as long.
#
# /mnt/sources has what apt has verified, /mnt/compile is for what is made on the way. MACHINE is the
# kind of computer (`x86_64`, `aarch64`). One of another kind counts as this one: its programs run, by
# emulation, and `gcc` compiles for it.
set -eu

jobs=$(nproc)
export DEB_BUILD_MAINT_OPTIONS=hardening=+bindnow DEB_CFLAGS_STRIP=-g
eval "$(dpkg-buildflags --export=sh)"
# A compiler for another kind of computer does not look there by itself.
CPPFLAGS="$CPPFLAGS -I/usr/local/include"
LDFLAGS="$LDFLAGS -L/usr/local/lib"
export PKG_CONFIG_PATH=/usr/local/lib/pkgconfig

unpack() { # NAME: its source with Debian's patches, and go there
    cd /mnt/compile
    dpkg-source --no-check --extract /mnt/sources/"$1"_*.dsc "$1"
    cd "$1"
}

unpack openssl
# /usr/lib/ssl: the certificates that the computer trusts, where Debian and Ubuntu have them.
# All in one library: providers and engines beside it would not be found in the one file.
./Configure "linux-$MACHINE" --prefix=/usr/local --libdir=lib --openssldir=/usr/lib/ssl \
    no-apps no-docs no-tests no-module no-legacy no-ssl3 no-ssl3-method no-idea no-mdc2 no-rc5 \
    "$CFLAGS $CPPFLAGS" "$LDFLAGS"
# Without the static libraries, for which everything would be compiled twice.
make -j"$jobs" LIBS= build_libs
make LIBS= INSTALL_LIBS= install_dev

unpack sqlite3
# Of Debian's options those that change what the appliance's statements do.
options="-DSQLITE_SECURE_DELETE -DSQLITE_ENABLE_COLUMN_METADATA -DSQLITE_MAX_VARIABLE_NUMBER=250000"
./configure --build="$MACHINE-linux-gnu" --prefix=/usr/local --disable-static --disable-tcl --disable-readline \
    CFLAGS="$CFLAGS $options"
make -j"$jobs"
make install

unpack python3.11
# A correction of Debian's includes what only Python's own parts may, and Debian has pyexpat among these.
cat >Modules/Setup.local <<END
*shared*
pyexpat pyexpat.c -DPy_BUILD_CORE_MODULE -lexpat
END
optimize=
if [ "${1:-}" = optimized ]; then
    optimize="--enable-optimizations --with-lto"
    # Of the tests that make the profile one needs the modules that are left out, and one another SQLite;
    # Debian's sources give up where a test fails.
    sed -i "/'test_embed'/d; /'test_sqlite3'/d" Lib/test/libregrtest/pgo.py
fi
# shellcheck disable=SC2086
./configure --build="$MACHINE-linux-gnu" --prefix=/usr/local --enable-shared --without-static-libpython \
    --with-openssl=/usr/local --with-system-expat --disable-test-modules --without-ensurepip $optimize
make -j"$jobs"
make install

# Python leaves out a module whose library it does not find, and says so in passing.
python3.11 -c '
import _bz2, _ctypes, _lzma, _uuid, pyexpat, sqlite3, ssl, zlib
print(ssl.OPENSSL_VERSION, "and SQLite", sqlite3.sqlite_version)
assert ssl.HAS_TLSv1_3
'
