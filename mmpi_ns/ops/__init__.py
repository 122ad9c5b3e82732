"""Operations, the inner loops. Each has a folder that defines it in plain torch (``dispatch.operation``), with compiled
forms of the same signature: ``NAME_on_cpu`` calls C++, ``gpu.py`` has the Triton kernels. The companion packages have
such folders too."""
