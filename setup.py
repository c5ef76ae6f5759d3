"""Wheels carry data/, design/, notebooks/ and examples/ in malta/shipped/; all else is in pyproject.toml."""

from pathlib import Path
from shutil import copytree, ignore_patterns

from setuptools import setup
from setuptools.command.build_py import build_py

FOLDERS = ("data", "design", "notebooks", "examples")
SKIPPED = ignore_patterns("__pycache__", "*.pyc", "build", ".ipynb_checkpoints", "*.npz.tmp")


class BuildWithFolders(build_py):
    """Copy the folders that an installed malta reads beside its modules."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:  # a checkout reads them where they are
            return
        for folder in FOLDERS:
            if Path(folder).is_dir():
                copytree(
                    folder,
                    Path(self.build_lib, "malta", "shipped", folder),
                    ignore=SKIPPED,
                    dirs_exist_ok=True,
                )


setup(cmdclass={"build_py": BuildWithFolders})
