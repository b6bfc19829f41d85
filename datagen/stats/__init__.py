"""A dataset as a page to look at: distributions, balance, concerns and a contact sheet."""
