"""Collecting experience: TorchRL's collectors, and one quick path beside them (switch ``collector.fast``).

The quick path is four parts: :mod:`~egopose.collection.stepping` steps and resets worlds without a TensorDict a step,
:mod:`~egopose.collection.env_groups` lets some worlds' physics run while the policy acts for the others,
:mod:`~egopose.collection.lazy_rewards` works rewards and log-probabilities out once per batch, and
:mod:`~egopose.collection.moments` merges the normaliser's statistics of several processes.
"""
