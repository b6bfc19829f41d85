"""Infrastructure of every package: commands, sockets, files, compiled kernels, HTML and charts."""
