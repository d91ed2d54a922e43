"""Where chunks run: anything with `submit(function, *args)` that returns a future.

On one machine, with processes:

    from concurrent.futures import ProcessPoolExecutor
    sweep(function, designs, store, ProcessPoolExecutor(mp_context=get_context("spawn")))

Workers need the precision of their driver: set JAX_ENABLE_X64=1 in the environment, which
they inherit. JAX makes pickled arrays single in a process that has not got it.

With Dask, the official extra `sorojax[sweep]`, two lines locally and two for a queue:

    client = sweep.dask_local(workers=2)
    sweep(function, designs, store, client)

    cluster = dask_jobqueue.SLURMCluster(cores=4, memory="8GB"); cluster.scale(jobs=20)
    sweep(function, designs, store, distributed.Client(cluster))

Workers run what they are sent: who can reach a scheduler can run code on it. `dask_local`
listens on the loopback only. Beyond one machine use TLS, with keys of your own:
`distributed.security.Security(tls_ca_file=..., tls_client_cert=..., tls_client_key=...,
require_encryption=True)`, given to the cluster and to the client.
"""

from concurrent.futures import Future
from typing import Any


class Serial:
    """Runs every chunk at once, in this process."""

    def submit(self, function, /, *args: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(function(*args))
        except Exception as error:
            future.set_exception(error)
        return future


def dask_local(workers: int, **options: Any) -> Any:
    """A Dask client with worker processes of one thread on this machine's loopback.

    Needs `distributed`, the extra `sorojax[sweep]`. Close it: `client.shutdown()`.
    """
    from distributed import Client, LocalCluster

    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        **{"dashboard_address": None, **options},
    )
    return Client(cluster)
