"""What several tests of stage 1 share."""

from collections.abc import Iterator

import pytest

from tumble.poses.sfm import circular_motion


@pytest.fixture(scope="module")
def no_turntable() -> Iterator[None]:
    """For captures that are no turntables: that white frames look alike by chance would cost seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(circular_motion, "periods", lambda capture: [])
        yield
