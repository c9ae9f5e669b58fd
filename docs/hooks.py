"""MkDocs hooks: the site includes the files outside docs/ to which pages link."""

from __future__ import annotations

import pathlib
import re
from typing import Any

ROOT = pathlib.Path(__file__).resolve().parents[1]
BESIDE = ('examples', 'benchmarks', 'colab')


def on_files(files: Any, config: Any) -> Any:
    """Adds the files of the folders in `BESIDE`, which are next to docs/."""
    from mkdocs.structure.files import File

    for name in BESIDE:
        for path in (ROOT / name).glob('*.*'):
            uri = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replaces links to files outside docs/ by links inside the site."""
    return re.sub(rf'\]\(\.\./({"|".join(BESIDE)})/', r'](\1/', markdown)
