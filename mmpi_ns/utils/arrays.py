"""Files of arrays (.npz), written one array after the other."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[np.generic]]
Pairs = Iterable[tuple[str, NDArray[np.generic]]]


def write_arrays(path: Path, arrays: Arrays | Pairs) -> None:
    """Writes an .npz, whatever the file's ending."""
    with zipfile.ZipFile(path, "w") as file:  # as np.savez, which asks for all arrays at once
        for name, array in arrays.items() if isinstance(arrays, Mapping) else arrays:
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), version=(1, 0), allow_pickle=False)
