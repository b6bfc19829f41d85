"""The demo: the whole pipeline in one command, with tables and an HTML report."""
