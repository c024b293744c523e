"""Clean: what the finished map says was seen through."""
