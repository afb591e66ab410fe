"""The decision process in equations: small pure functions over batched tensors, one per equation of the papers.

Everything here sees only *body states*: TensorDicts in float64 with batch ``[N]`` and the keys ``qpos [N, nq]``,
``qvel [N, nv]``, ``xpos [N, B, 3]``, ``xquat [N, B, 4]`` and ``com [N, 3]``. The simulated state and the reference have
the same keys. Quaternions are ``wxyz``; the *heading frame* is the world frame turned by the root's heading.
"""
