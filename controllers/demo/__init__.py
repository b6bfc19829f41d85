"""`controllers demo`: the whole pipeline in one go, told in a table and an HTML report."""
