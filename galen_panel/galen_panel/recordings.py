"""The recordings at hand, and the reports on them."""

from __future__ import annotations

from pathlib import Path

from starlette.applications import Starlette


class Recordings:
    """Finds bags below a directory, evaluates and diagnoses them."""

    def __init__(self, bags_dir: Path, tools_dir: Path, output_dir: Path) -> None:
        self.bags_dir, self.tools_dir, self.output_dir = bags_dir, tools_dir, output_dir

    def serve(self, app: Starlette) -> None:
        """Add the routes of reports and pictures."""

    def close(self) -> None:
        """End what runs."""
