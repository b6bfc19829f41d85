"""What every package uses: commands, sockets, files, compiled functions, HTML pages and charts."""
