"""C that was compiled before in this session is not compiled again, as by ccache."""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from quadjax.export.verify.toolchain import Compiler


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Results of equal preprocessed sources and options are copied, for all workers."""
    root, build = tmp_path_factory.getbasetemp(), Compiler.build
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "compiled"
    folder.mkdir(exist_ok=True)

    def cached(
        self: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
    ) -> Path:
        if self.name == "zig cc" or any(Path(source).suffix != ".c" for source in sources):
            return build(self, sources, output, extra)
        own = [*self.command, *self.flags, *(word for word in extra if not word.startswith("-I"))]
        command = [*self.command, *self.flags, "-E", "-P", *map(str, sources), *extra]
        done = subprocess.run(command, capture_output=True)
        if done.returncode:
            return build(self, sources, output, extra)
        kept = folder / hashlib.sha256("\0".join(own).encode() + done.stdout).hexdigest()
        if not kept.exists():
            build(self, sources, output, extra)
            temporary = kept.with_suffix(f".{os.getpid()}")
            shutil.copy(output, temporary)
            temporary.replace(kept)
        else:
            Path(output).unlink(missing_ok=True)  # not written into, where it is loaded
            shutil.copy(kept, output)
        return output

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Compiler, "build", cached)
        yield
