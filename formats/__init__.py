"""Files: paths in, numpy records out. One reader and one writer for each artifact."""
