"""How the one file and the Debian package are made, and what runs first in them."""
