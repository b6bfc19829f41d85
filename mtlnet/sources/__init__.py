"""Reads images from files, folders, films, recorded rounds, recordings of other programs, webcams
and streams."""
