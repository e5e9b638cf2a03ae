"""Hook of mkdocs.yml: the site shows the repository's documents at their own paths."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

# Whatever a document may link to. Links then lead to the same place on the site and in the repository.
PATTERNS = ("*", "docs/*", "notebooks/*", "results/**/*")
SUFFIXES = {".md", ".png", ".svg", ".json", ".ipynb", ".cff"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replaces the files of docs/ by the documents of the whole repository."""
    root = Path(config.docs_dir).parent
    for file in list(files):
        if file.src_dir == config.docs_dir:
            files.remove(file)
    for path in sorted(path for pattern in PATTERNS for path in root.glob(pattern)):
        if path.suffix in SUFFIXES:
            name = path.relative_to(root).as_posix()
            files.append(File(name, str(root), config.site_dir, config.use_directory_urls))
    return files
