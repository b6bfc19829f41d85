"""Code that all packages use: commands, sockets, files, compilation, films, HTML pages, charts."""
