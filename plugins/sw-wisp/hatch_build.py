"""Tag a wheel that holds compiled kernels with the platform they are for: any Python, any torch."""

import os
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PlatformTag(BuildHookInterface):  # type: ignore[type-arg]
    """Tags wheels with libraries in `prebuilt` folders; others, and editable installs, stay as they are."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it builds."""
        if version == "standard" and any(Path(self.root, "src").rglob("prebuilt/*.so")):
            own = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{os.environ.get('SPLATWIZARD_WHEEL_PLATFORM') or own}"
