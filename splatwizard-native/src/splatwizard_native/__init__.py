"""C++ and CUDA modules for torch, the fused loss and Adam, and the cores of a process.

Importing this imports no torch. `__init__.pyi` lists what is offered here; each name is imported on first use.
"""

from splatwizard_native.lazy_imports import lazy_exports

__all__, __getattr__ = lazy_exports(__name__)
