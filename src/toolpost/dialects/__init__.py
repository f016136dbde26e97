"""Dialects: the public APIs. Each only translates between its own words and the shop's."""
