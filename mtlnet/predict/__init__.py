"""The command `mtlnet predict`, which writes the track features of images, films and recordings as
tables, pictures, films or recordings."""
