"""Where transitions wait for the learner, and the files that hold them. Numpy only: no torch, no Ray.

`schema` says what a row holds, `ring` stores rows, `ledger` knows which blocks have arrived; `shard` joins the three
and `sharded` samples over several. `limiter` decides who may go on. `codec`, `snapshot` and `dataset` are their files.
"""
