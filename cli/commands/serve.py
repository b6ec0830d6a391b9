"""``clipmap serve``: the block service in this process."""

from collections.abc import Sequence
from typing import Final

import click

LOG_LEVELS: Final = ("error", "warning", "info", "debug")
_NAMES_SHOWN: Final = 8


@click.command()
@click.argument("roots", metavar="DATASET_OR_DIR...", nargs=-1, required=True)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; 0.0.0.0 for every network of this machine.")
@click.option("--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="TCP port to listen on; 0 picks a free one.")
@click.option("--log-level", default="warning", show_default=True, type=click.Choice(LOG_LEVELS), help="'info' logs every request.")
def command(roots: tuple[str, ...], host: str, port: int, log_level: str) -> None:
    """Serve datasets over HTTP until Ctrl-C or SIGTERM.

    DATASET_OR_DIR is a dataset, a folder of datasets, or the URL of a dataset in an object store, such as s3://bucket/alps, which is
    then called alps. Datasets that are added to such a folder, rebuilt or removed are noticed without a restart. Blocks are
    handed out as they are stored, to everyone who can reach the address.
    """
    import logging

    from schemas.settings import ServerSettings
    from server.app import create_app
    from server.catalog import Catalog
    from server.listener import listen, run_until_stopped, url_of

    logging.basicConfig(level=log_level.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    app = create_app(ServerSettings(roots=roots, host=host, port=port))
    catalog: Catalog = app.state.catalog
    with listen(host, port) as listener:
        line = f"Serving {_names(catalog.names())} at {url_of(listener)}"
        run_until_stopped(app, listener, access_log=log_level in ("info", "debug"), ready=lambda: click.echo(line))


def _names(names: Sequence[str]) -> str:
    if not names:
        return "no dataset yet"
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    return ", ".join(names[:_NAMES_SHOWN]) + more
