"""The viewer: a page on this machine that streams a map, and the server behind it."""
