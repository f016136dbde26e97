"""Makes the package ``tests`` importable for whichever part of it is run (pytest: rootdir/conftest)."""
