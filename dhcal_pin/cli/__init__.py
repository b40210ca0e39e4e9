"""The command line of dhcal."""
