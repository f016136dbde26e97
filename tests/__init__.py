"""The tests. A package, so that each can say ``from tests.harness import Server``."""
