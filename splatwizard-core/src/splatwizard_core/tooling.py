"""The face of the core for packages about runs (reports, sweeps, diagnoses, viewers), besides `api`.

`tooling.pyi` lists its names, docs/plugins.md describes each; unlike those of `api` they are not promised to stay.
"""

from splatwizard_native import lazy_exports

__all__, __getattr__ = lazy_exports(__name__)
