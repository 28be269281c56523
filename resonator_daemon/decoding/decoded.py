"""What every decoder returns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Bools, Floats


@dataclass(frozen=True)
class Decoded:
    """One decoded frame, or a stack of them: leading axes of the signals are leading axes here.

    Components are x, y, z; a traction is what the object exerts: f_z > 0 presses; u_z > 0 is indentation.
    Where `status` is neither "ok" nor "constraint_dropped" the numbers of the surface are NaN and `reason` says why.
    "constraint_dropped": contact physics did not fit the signals, and `reason` says what is shown in its place.
    """

    traction_pascal: Floats  # (..., 3, ny, nx) or (..., 3, m)
    traction_std_pascal: Floats  # of the same shape
    displacement_m: Floats | None  # of the same shape, where asked for
    border_contact: bool | Bools  # (...): the load reaches the border, expect errors there
    log_evidence: float | Floats  # (...): log density of the signals under the decoder's model
    chi2: float | Floats  # (...): about 1 where signals scatter as the model and the declared noise say
    status: str | NDArray[np.str_]  # (...)
    reason: str | NDArray[np.str_]  # (...): empty where there is nothing to say

    @classmethod
    def stack(cls, frames: Sequence[Self], leading: tuple[int, ...], shape: tuple[int, ...]) -> Self:
        """Single frames, of surface arrays of `shape`, in row order of the `leading` axes."""
        displacements = [frame.displacement_m for frame in frames if frame.displacement_m is not None]
        return cls(
            traction_pascal=np.array([frame.traction_pascal for frame in frames]).reshape(*leading, *shape),
            traction_std_pascal=np.array([frame.traction_std_pascal for frame in frames]).reshape(*leading, *shape),
            displacement_m=np.array(displacements).reshape(*leading, *shape) if displacements else None,
            border_contact=np.array([frame.border_contact for frame in frames], np.bool_).reshape(leading),
            log_evidence=np.array([frame.log_evidence for frame in frames], np.float64).reshape(leading),
            chi2=np.array([frame.chi2 for frame in frames], np.float64).reshape(leading),
            status=np.array([frame.status for frame in frames], np.str_).reshape(leading),
            reason=np.array([frame.reason for frame in frames], np.str_).reshape(leading),
        )
