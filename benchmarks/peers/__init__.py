"""Other codes, each in its own virtual environment and its own process.

`call` is for cases; `python -m benchmarks.peers install` makes the environments. The
script `<peer>.py` here is run by the peer's own interpreter and never imported.
"""

from benchmarks.peers.call import PeerMissing as PeerMissing, call as call, row as row
