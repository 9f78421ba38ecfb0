"""The finer shape prior's own data: more bodies, parts with detail, captions with removal, views of 64 pixels."""
