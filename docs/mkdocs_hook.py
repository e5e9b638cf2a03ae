"""Hook of mkdocs.yml: the site shows the repository's documents at their own paths."""

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

# Whatever a document may link to. Links then lead to the same place on the site and in the repository.
SHOWN = ("*.md", "LICENSE", "docs/*.md", "docs/*.svg", "notebooks/*.ipynb", "results/**/*.*")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replaces the files of docs/ by those of the whole repository that are documents."""
    root = Path(config.docs_dir).parent
    for file in list(files):
        if file.src_dir == config.docs_dir:
            files.remove(file)
    for path in sorted({path for pattern in SHOWN for path in root.glob(pattern) if path.is_file()}):
        name = path.relative_to(root).as_posix()
        files.append(File(name, str(root), config.site_dir, config.use_directory_urls))
    return files
