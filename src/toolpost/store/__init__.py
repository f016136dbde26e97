"""What must outlive the process: jobs, programs, settings, keys and what clients keep here."""

from pathlib import Path

from toolpost.store.database import Database
from toolpost.store.jobs import JobStore
from toolpost.store.keys import KeyStore
from toolpost.store.namespaces import NamespaceStore
from toolpost.store.programs import ProgramStore
from toolpost.store.settings import SettingStore


class Store:
    """All that is stored under a data directory but telemetry and logs.

    Args:
        directory: the data directory, which must exist.

    Raises:
        StartError: the database cannot be opened.
    """

    def __init__(self, directory: Path) -> None:
        self._database = Database(directory / "toolpost.db")
        try:
            self.jobs = JobStore(self._database)
            self.settings = SettingStore(self._database)
            self.keys = KeyStore(self._database)
            self.namespaces = NamespaceStore(self._database)
            self.programs = ProgramStore(directory / "programs")
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Make durable what is queued and close."""
        self._database.close()
