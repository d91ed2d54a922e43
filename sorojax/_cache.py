"""The persistent compilation cache: on in the command line, examples, tests and
benchmarks; never switched on by an import. Beside it a folder of trained models.

Whoever can write to the cache can run code in the process that reads it, so the
directory belongs to one user and to nobody else. Compiled programs hold instructions of the
processor, so each type of processor has a folder of its own.
"""

import hashlib
import os
import platform
import stat
import warnings
from pathlib import Path


def cache_directory() -> Path:
    """Where compiled programs for this type of processor are kept: in `$SOROJAX_CACHE/jax`, by
    default in `$XDG_CACHE_HOME/sorojax/jax` or `~/.cache/sorojax/jax`."""
    return _root() / "jax" / _processor()


def cached_programs() -> tuple[int, float]:
    """How many compiled programs are kept for this type of processor, and their size [MB]."""
    files = [path for path in cache_directory().glob("*-cache") if path.is_file()]
    return len(files), sum(path.stat().st_size for path in files) / 1e6


def clear_compilation_cache() -> int:
    """Delete the compiled programs for all types of processor, and nothing else that may stand
    there; how many there were."""
    folder, count = _root() / "jax", 0
    for pattern in ("*-cache", "*-atime", "*/*-cache", "*/*-atime"):
        for path in folder.glob(pattern):
            path.unlink()
            count += path.name.endswith("-cache")
    for path in folder.glob(f"{platform.machine()}-*"):
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()
    return count


def enable_compilation_cache() -> Path | None:
    """Switch on JAX's persistent compilation cache in `cache_directory()`.

    Returns:
        The directory, or `None` with a warning if it cannot be made.

    Raises:
        ValueError: If the directory belongs to, or can be written by, someone else.
    """
    import jax

    try:
        directory = _private_directory()
    except OSError as error:
        warnings.warn(
            f"sorojax: no compilation cache, cannot make {cache_directory()} "
            f"({error.strerror}): every run compiles again. Set SOROJAX_CACHE to a "
            "directory that you can write.",
            stacklevel=2,
        )
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return directory


def trained_directory() -> Path:
    """Where trained models are kept, made if it is not there: `$SOROJAX_CACHE/trained`.

    Raises:
        ValueError: If the directory belongs to, or can be written by, someone else.
    """
    return _private(_root(), _root() / "trained")


def _root() -> Path:
    if own := os.environ.get("SOROJAX_CACHE"):
        return Path(own).expanduser().absolute()
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base).expanduser().absolute() / "sorojax"


def _processor() -> str:
    """A name for this type of processor."""
    rows = [platform.processor()]
    if (listed := Path("/proc/cpuinfo")).exists():
        named = ("model name", "flags", "Features", "CPU part")
        rows += [row for row in listed.read_text().splitlines() if row.startswith(named)]
    digest = hashlib.sha256("\n".join(sorted(set(rows))).encode()).hexdigest()
    return f"{platform.machine()}-{digest[:12]}"


def _private_directory() -> Path:
    directory = cache_directory()
    return _private(_root(), directory.parent, directory)


def _private(*folders: Path) -> Path:
    """The last of the folders, each in the one before, made and closed to others."""
    folders[0].parent.mkdir(parents=True, exist_ok=True)
    for path in folders:
        path.mkdir(mode=0o700, exist_ok=True)
        _refuse_shared(path)
        path.chmod(0o700)
    return folders[-1]


def _refuse_shared(path: Path) -> None:
    if not hasattr(os, "getuid"):  # Windows: user profiles are private
        return
    status = path.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise ValueError(
            f"compilation cache: {path} is a link or belongs to someone else, need a "
            "directory of your own. Set SOROJAX_CACHE to one."
        )
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise ValueError(
            f"compilation cache: {path} has mode {status.st_mode & 0o777:04o}, others can "
            "put programs there that you would run, need 0700. Look at who wrote there, "
            f"then: rm -r {path}"
        )
