"""`evercal verify`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next


@dataclass(frozen=True)
class Verify:
    """Check every file of a store against its checksum.

    Example: evercal verify cell.evercal
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print every problem; exit code 1 if there is one."""
        from evercal.storage import verify

        problems = verify(self.store)
        if self.json:
            print_json({"store": str(self.store), "ok": not problems, "problems": problems})
            return 1 if problems else 0
        for problem in problems:
            print(problem)
        if problems:
            files = "1 file is" if len(problems) == 1 else f"{len(problems)} files are"
            print(f"{files} damaged; restore from a copy of the store")
            print_next("evercal", "verify", self.store)
            return 1
        print(f"{self.store}: all files match their checksums")
        print_next("evercal", "localize", self.store, "IMAGE")
        return 0
