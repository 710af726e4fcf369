"""Builds the single executable and the Debian package; `entry` is the executable's entry point."""
