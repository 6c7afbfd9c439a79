"""The version of the installed package."""


def program_version() -> str:
    """Return the version of the installed package, or "unknown" if it runs without being installed."""
    import importlib.metadata  # here, since it takes longer than the start of the command line

    try:
        return importlib.metadata.version("prt-bake")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
