"""The statistics page of a dataset: distributions, balance, concerns and a contact sheet."""
