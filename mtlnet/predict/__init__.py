"""`mtlnet predict`: track features of images, films and recorded rounds, as tables and pictures."""
