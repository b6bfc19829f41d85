"""Sources of images: files, folders, films, recorded rounds, other recordings, webcams, streams."""
