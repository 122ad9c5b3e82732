"""Inner loops of baked scenes and splats: definition and C++, one folder each."""

from pathlib import Path

OPS = Path(__file__).parent
