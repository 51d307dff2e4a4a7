"""What we use of numba and Snakemake that they do not promise: there as when it was last checked,
or what to do.
"""

import inspect


def test_numba_keeps_kernels_as_our_cache_expects():
    """Checked with numba 0.62.0 and 0.68.1. If this fails: mend `_ByModule` and `_KernelCache` in
    kernels/jit.py after numba/core/caching.py, or give kernels `cache=True`, at the cost of
    compiling anew in every clone.
    """
    from numba.core import caching

    locator, files, cache = (
        caching._CacheLocator,
        caching.CompileResultCacheImpl,
        caching.FunctionCache,
    )
    asked = {
        "from_function",
        "get_cache_path",
        "get_source_stamp",
        "get_disambiguator",
        "ensure_cache_path",
    }
    assert asked <= {name for name, _ in inspect.getmembers(locator)}
    assert isinstance(files._locator_classes, list) and cache._impl_class is files
    assert list(inspect.signature(cache.load_overload).parameters) == [
        "self",
        "sig",
        "target_context",
    ]
    assert list(inspect.signature(cache.save_overload).parameters) == ["self", "sig", "data"]


def test_numba_calls_our_cache_where_a_dispatcher_has_one():
    """Checked with numba 0.62.0 and 0.68.1. If this fails: `_compiled` in kernels/jit.py has to set
    it elsewhere.
    """
    from chebsplat.rasterize import tiles

    dispatcher = next(value for value in vars(tiles).values() if hasattr(value, "py_func"))
    assert type(dispatcher._cache).__name__ == "_KernelCache" and dispatcher._cache.cache_path


def test_numba_has_what_explicit_vectors_are_made_of():
    """Checked with numba 0.62.0 and 0.68.1. If this fails: chebsplat/kernels/simd.py and
    rasterize/blocks.py build LLVM instructions with these; their plain twins are in
    rasterize/cells.py.
    """
    from numba.core import cgutils, event, types
    from numba.core.typing.templates import signature

    assert (
        callable(cgutils.alloca_once) and callable(signature) and issubclass(event.Listener, object)
    )
    assert issubclass(types.UniTuple, types.Type)


def test_snakemake_takes_its_cache_from_a_folder_that_we_name():
    """Checked with Snakemake 9.3.0 and 9.27.1. If this fails: `SNAKEMAKE` in running/processes.py
    sets APPDIRS so that no cache lies in a home folder, which may be full; set XDG_CACHE_HOME there
    instead.
    """
    import snakemake.common

    assert snakemake.common.APPDIRS is None  # until it is first asked for, which we forestall
    assert isinstance(snakemake.common.get_appdirs().user_cache_dir, str)
