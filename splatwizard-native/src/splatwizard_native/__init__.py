"""C++ and CUDA modules for torch, the fused loss and Adam, cores and memory of a process, progress on the terminal.

Importing this imports no torch. `__init__.pyi` lists what is offered here; each name is imported on first use.
"""

from splatwizard_native.lazy_imports import lazy_exports

__all__, __getattr__ = lazy_exports(__name__)
