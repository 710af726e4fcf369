"""The commands, each group in a module of its own; `appliance.cli.main` puts them together."""
