"""The command `appliance`, which `python -m appliance` is too."""

from __future__ import annotations

import sys
from typing import NoReturn

from appliance.host import libraries


def main() -> NoReturn:
    """Run the command; a library that this computer cannot load is explained."""
    try:
        from appliance.cli.main import main as run

        run()
    except ImportError as error:
        explanation = libraries.explain(error)
        if explanation is None:
            raise
        sys.exit(f"appliance: {explanation}")


if __name__ == "__main__":
    main()
