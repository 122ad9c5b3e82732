"""Operations: the inner loops. Each is a folder that defines it in plain torch (``dispatch.operation``), with compiled
forms of the same signature beside it: ``cpu.py`` with C++, ``gpu.py`` with Triton."""
