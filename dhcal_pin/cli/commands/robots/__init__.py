"""Commands of `dhcal` on robot files alone: their conversion, use and comparison, without a fit.

One module per command, as in `cli/commands`.
"""
