"""The commands, each group in a module of its own; `appliance.cli` puts them together."""
