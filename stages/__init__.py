"""One command each: read artifacts, call the maths, publish one artifact."""
