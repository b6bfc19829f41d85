"""`controllers demo`: the whole pipeline in one command, with a table and an HTML report."""
