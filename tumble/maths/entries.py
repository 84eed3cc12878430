"""One entry of a batch, by an index of Python or by one that only the device knows."""

from jaxtyping import Int64, Shaped
from torch import Tensor

Index = int | Int64[Tensor, ""]
"""Index of an entry. A tensor lies on the device of the batch; the host does not wait for its value."""


def entry(batch: Shaped[Tensor, "n *rest"], index: Index) -> Shaped[Tensor, "*rest"]:
    """The entry of a batch with an index: a view of it if the index is a number, else a copy."""
    return batch[index] if isinstance(index, int) else batch.index_select(0, index)[0]
