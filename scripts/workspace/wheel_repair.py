"""Repairs the ROS wheels' CMake files.

Their exported targets name the folders of the machine that built the wheels:
``/opt/python/cpXY-cpXY/include/python3.Y`` and numpy's headers below it. Both become the
environment's own.
"""

from __future__ import annotations

import re
from pathlib import Path

_BUILDER = r"/opt/python/cp\d+-cp\d+"
_NUMPY = re.compile(_BUILDER + r"/lib/python3\.\d+/site-packages/numpy/(?:_core|core)/include")
_PYTHON = re.compile(_BUILDER + r"/include/python3\.\d+")


def repair_wheels(prefix: Path, python_include: str, numpy_include: str) -> int:
    """Rewrite the builder's folders in ``<prefix>/share/*/cmake/*.cmake``.

    Returns:
        How many files were changed; a second call changes none.

    """
    changed = 0
    for path in sorted(prefix.glob("share/*/cmake/*.cmake")):
        text = path.read_text(encoding="utf-8")
        fixed = _NUMPY.sub(lambda _: numpy_include, text)
        fixed = _PYTHON.sub(lambda _: python_include, fixed)
        if fixed != text:
            path.write_text(fixed, encoding="utf-8")
            changed += 1
    return changed
