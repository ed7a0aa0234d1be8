"""C that was compiled before in this session is not compiled again, as by ccache."""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from quadjax.export.compiler import Compiler, Failed


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Objects of equal preprocessed sources and options are kept, for all workers."""
    root, build = tmp_path_factory.getbasetemp(), Compiler.build
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "compiled"
    folder.mkdir(exist_ok=True)

    def compiled(self: Compiler, source: Path, options: Sequence[str]) -> Path:
        """The object of a source; an object as it is."""
        if Path(source).suffix != ".c":
            return source
        command = [*self.command, *self.flags, "-E", "-P", str(source), *options]
        done = subprocess.run(command, capture_output=True)
        if done.returncode:
            raise Failed("not preprocessed")
        words = [word for word in options if not word.startswith(("-I", "-D"))]
        text = "\0".join([*self.command, *self.flags, *words]).encode() + done.stdout
        kept = folder / f"{hashlib.sha256(text).hexdigest()}.o"
        if not kept.exists():
            temporary = kept.with_suffix(f".{os.getpid()}")
            build(self, [source], temporary, [*options, "-c"])
            temporary.replace(kept)
        return kept

    def cached(
        self: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
    ) -> Path:
        if self.name == "zig cc":
            return build(self, sources, output, extra)
        try:
            objects = [compiled(self, source, extra) for source in sources]
        except Failed:  # with the message of a build of them all
            return build(self, sources, output, extra)
        Path(output).unlink(missing_ok=True)  # not written into, where it is loaded
        if "-c" not in extra:
            return build(self, objects, output, extra)
        shutil.copy(objects[0], output)
        return output

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Compiler, "build", cached)
        yield
