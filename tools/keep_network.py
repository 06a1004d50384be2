"""Store the network of a run as the one from which `pp-cl train --network demo` starts.

    python -m tools.keep_network runs/network

`make network` trains that run first.
"""

import sys

import numpy as np

from pp_cl.checkpoint import opened_run
from pp_cl.config import load_config
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.start import DEMO_NETWORK


def main() -> None:
    """Write DEMO_NETWORK."""
    folder = RunFolder(sys.argv[1])
    with opened_run(folder, load_config(folder.config)) as run:
        names = [name for name in run.forms if name.startswith("net.")]
        np.savez(DEMO_NETWORK, **{name: run.array(name).astype(np.float16) for name in names})
    print(f"wrote {DEMO_NETWORK}")


if __name__ == "__main__":
    main()
