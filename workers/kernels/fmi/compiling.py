"""Compiling loops: ways in only where they are used, kept on disk, each function optimised once.

numba optimises a function with all that it calls, makes machine code of it, and does so again for
every function that calls it. Here only the loops that Python calls are optimised and made machine
code, with all that they call; the others are only translated. That takes half the time.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba import _dynfunc, config, njit
from numba.core import typed_passes, untyped_passes
from numba.core.caching import IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass

from workers.caches import cache_folder as private_folder
from workers.caches import is_mine, write_whole

_NEWEST_KNOWN = (0, 68)
"""The newest numba whose way of compiling is known here. Newer ones compile as they always do."""

_UNUSED_PASSES = (
    untyped_passes.WithLifting,
    untyped_passes.InlineClosureLikes,
    untyped_passes.GenericRewrites,
    untyped_passes.RewriteDynamicRaises,
    untyped_passes.MakeFunctionToJitFunction,
    untyped_passes.InlineInlinables,
    untyped_passes.FindLiterallyCalls,
    untyped_passes.LiteralUnroll,
    untyped_passes.LiteralPropagationSubPipelinePass,
    typed_passes.InlineOverloads,
    typed_passes.NopythonRewrites,
)
"""What numba does for closures, lists, arrays as a whole and the like, which no loop here has."""


class _PartOfCallers(JITCodeLibrary):
    """The code of a function that only gets into the code of its callers."""

    def add_llvm_module(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout
        self._final_module.link_in(ll_module)

    def finalize(self) -> None:
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _TranslationForCallers(typed_passes.NativeLowering):
    """Translation to the compiler's language, with nothing that could be called from Python."""

    _name = "translation_for_callers"

    def run_pass(self, state: Any) -> bool:
        state.library = _PartOfCallers(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        function = state.cr.fndesc
        entry = _dynfunc.make_function(
            function.lookup_module(), function.qualname, "", 0, state.cr.env, (state.library,)
        )
        state.targetctx.insert_user_function(entry, function, [state.library])
        state.cr = state.cr._replace(cfunc=entry)
        return True


class _CompilerForCallers(CompilerBase):
    """What numba does for a function, without what is not used, up to its translation."""

    def define_pipelines(self) -> list[Any]:
        passes = PassManager("for_callers")
        for part in (
            DefaultPassBuilder.define_untyped_pipeline(self.state),
            DefaultPassBuilder.define_typed_pipeline(self.state),
        ):
            passes.passes.extend(each for each in part.passes if each[0] not in _UNUSED_PASSES)
        passes.add_pass(typed_passes.IRLegalization, "ensure IR is legal prior to lowering")
        passes.add_pass(typed_passes.AnnotateTypes, "annotate types")
        passes.add_pass(_TranslationForCallers, "native lowering")
        passes.add_pass(typed_passes.NoPythonBackend, "nopython mode backend")
        passes.finalize()
        return [passes]


def for_callers(version: tuple[int, int]) -> dict[str, Any]:
    """Return how numba of this version compiles what Python does not call.

    In any version without ways in from Python and C, which take a third of the time.
    """
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    if version <= _NEWEST_KNOWN:
        options["pipeline_class"] = _CompilerForCallers
    return options


_FOR_CALLERS = for_callers(numba.version_info.short)

inlined = njit(forceinline=True, nogil=True, _nrt=False, **_FOR_CALLERS)
"""Compiles a helper into each loop that uses it."""

subroutine = njit(nogil=True, _nrt=False, **_FOR_CALLERS)
"""Compiles what only other loops call, like `kernel` otherwise; Python cannot call it."""


def cache_folder() -> Path:
    """A folder that belongs to this version of the loops and all their helpers.

    numba takes its cached code for a loop as long as the loop's own file is unchanged, whatever
    has happened to helpers from other files that are compiled into it.
    """
    sources = [file.read_bytes() for file in sorted(Path(__file__).parents[1].rglob("*.py"))]
    digest = hashlib.sha256(b"\0".join(sources)).hexdigest()[:16]
    return private_folder("kernels", config.CACHE_DIR) / digest


_CACHE_FOLDER = str(cache_folder())


def compiled_before(module: str = "") -> bool:
    """Return whether loops of this version have been compiled on this machine, and kept.

    Parameters
    ----------
    module
        The last name of one, to ask for its loops alone.
    """
    folder = Path(_CACHE_FOLDER)
    return folder.is_dir() and (not module or any(folder.rglob(f"{module}.*")))


class _CheckedFiles(IndexDataCacheFile):
    """The files of one loop, each of which ends with a digest of its name and what is in it.

    What is damaged, or another user's, is removed before it is read, and compiled anew.
    """

    def load(self, key: Any) -> Any:
        folder, loop = Path(self._cache_path), self._index_name.removesuffix("nbi")
        for file in folder.iterdir() if folder.is_dir() else ():
            if file.name.startswith(loop) and not _is_sealed(file):
                file.unlink(missing_ok=True)
        return super().load(key)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content, file = io.BytesIO(), Path(filepath)
        yield content
        written = content.getvalue()
        write_whole(file, written + _seal(file.name, written))  # of no account to who unpickles it


def _seal(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + content).digest()


def _is_sealed(file: Path) -> bool:
    """Return whether a file is whole, in its place and of this user; one that is gone is."""
    try:
        with file.open("rb") as opened:
            found, content = os.fstat(opened.fileno()), opened.read()
    except FileNotFoundError:
        return True
    size = hashlib.sha256().digest_size
    return is_mine(found) and content[-size:] == _seal(file.name, content[:-size])


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a loop that Python calls, without reference counting, and keep it on disk.

    Atomic counters around every call would cost several times the call. Nothing can be allocated
    inside; numba refuses to compile it.
    """
    before = config.CACHE_DIR
    config.CACHE_DIR = _CACHE_FOLDER  # read while decorating, and other users of numba keep theirs
    try:
        loop = njit(nogil=True, cache=True, _nrt=False, no_cfunc_wrapper=True)(function)
    finally:
        config.CACHE_DIR = before
    if numba.version_info.short <= _NEWEST_KNOWN:
        cache = loop._cache
        stamp = cache._impl.locator.get_source_stamp()
        cache._cache_file = _CheckedFiles(cache.cache_path, cache._impl.filename_base, stamp)
    return loop
