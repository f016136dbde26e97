"""The version of Toolpost."""

VERSION = "0.1.0"
