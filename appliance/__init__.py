import sys

# In words that any Python 3 can read, since an older one is what is told here.
if sys.version_info < (3, 10):  # noqa: UP036
    sys.exit(
        "appliance: needs Python 3.10 or later, and {} is Python {}.{}. Use a newer one, as in "
        "python3.11 -m venv ~/appliance, or the one file, which brings its own".format(
            sys.executable, *sys.version_info[:2]
        )
    )
