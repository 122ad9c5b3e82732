"""Operations: the inner loops. Each is a folder that defines it in plain torch (``dispatch.operation``), with compiled
forms of the same signature beside it: ``NAME_on_cpu`` calls C++, ``gpu.py`` has Triton's. Packages beside this one have
folders like it."""
