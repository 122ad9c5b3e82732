"""Operations: the inner loops. Each is a folder with one signature (``__init__.py``), its plain torch ``reference.py``,
and its compiled forms: ``cpu.py`` with C++, ``gpu.py`` with Triton. ``dispatch.py`` holds the table and the choice."""
