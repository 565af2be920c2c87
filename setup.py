"""Compiler options of the extension, which depend on the compiler; pyproject.toml has all else."""

from setuptools import setup
from setuptools.command.build_ext import build_ext


class BuildKernels(build_ext):
    """Build with optimization, in the words of the compiler that was found."""

    def build_extensions(self) -> None:
        """Add the options to each extension, then build."""
        msvc = self.compiler.compiler_type == "msvc"
        arguments = ["/O2", "/std:c11"] if msvc else ["-O3", "-fno-math-errno"]
        for extension in self.extensions:
            extension.extra_compile_args += arguments
        super().build_extensions()


setup(cmdclass={"build_ext": BuildKernels})
