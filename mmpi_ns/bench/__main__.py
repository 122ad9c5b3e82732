"""``python -m mmpi_ns.bench``: the same as ``mmpi-bench``."""

from mmpi_ns.scripts.bench import entrypoint

if __name__ == "__main__":
    entrypoint()
