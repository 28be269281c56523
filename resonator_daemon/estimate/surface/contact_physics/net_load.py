"""Force and moment of a contact with standard errors, from the least-squares traction on its support.

Bounds would bias the sums, and a linear map without a support adds weak opposite load around the contact.
"""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from resonator_daemon.base.arrays import Floats, Indices, Labels, Singles
from resonator_daemon.estimate.surface.contact_physics.support_problem import SupportProblem
from resonator_daemon.estimate.surface.patches import NetLoad

Blobs = frozenset[int]  # by number

_DIVIDED_AGAIN = 0.03  # share of the pixels that change sides before a blob is divided again
_F_Z, _M_X, _M_Y, _M_Z = 2, 3, 4, 5
# Of forces x, y, z and moments x, y, z; both to fit closed-form contacts.
_STD_FACTOR = np.array([1.2, 1.2, 1.0, 1.0, 1.0, 1.2])  # of the posterior's: contacts are not drawn from the prior
_PIXEL_ERROR = np.array([3e-4, 3e-4, 2e-4, 2e-4, 2e-4, 3e-4])  # of the force: traction is not even over each pixel


class LoadSums:
    """Sums of the right sides of a problem that are the loads of contacts; valid for any frame of the problem.

    A contact bears the load of all blobs of pixels that it touches. A blob that several contacts touch is divided
    between them by distance; a division holds while few pixels change sides.

    Parameters
    ----------
    problem
        Of n pixels.
    blobs
        Number of the blob of each pixel of the lattice, 0 where the problem has none, (pixels,).
    centres_m
        Of those pixels, (pixels, 2).
    area_m2
        Of a pixel.
    """

    def __init__(self, problem: SupportProblem, blobs: Labels, centres_m: Floats, area_m2: float) -> None:
        self._blobs = blobs
        self._pixels = problem.pixels
        self._blob_of = blobs[problem.pixels]
        self._centres_m = centres_m
        self._area_m2 = area_m2
        self._reference_m = centres_m[problem.pixels].mean(axis=0)
        self._unit = problem.model.std_pascal
        arms_m = centres_m[problem.pixels] - self._reference_m
        self._sums = _functionals(arms_m) * area_m2  # (6, 3, n)
        self._problem = problem
        self._parts = np.zeros(0, np.intp)  # which contact each pixel is nearest to, where a blob is divided, (n,)
        self._found: dict[tuple[Blobs, Blobs, int], _ContactSum] = {}  # by blobs, divided ones, part
        for blob in range(1, int(self._blob_of.max()) + 1):
            self._sum(frozenset({blob}), frozenset(), 0)

    def loads(self, places: Sequence[Indices], right_side: Singles, noise_std: float) -> list[NetLoad | None]:
        """Return the loads of contacts in a frame, moments about the origin; None for one that touches no blob.

        Parameters
        ----------
        places
            Indices of pixels of the lattice that belong to each contact.
        right_side
            Of the frame, (3 n,).
        noise_std
            Of the frame over that of the problem.
        """
        touched = [frozenset(self._blobs.take(pixels).tolist()) - {0} for pixels in places]
        contacts = Counter(blob for blobs in touched for blob in blobs)
        shared = frozenset(blob for blob, count in contacts.items() if count > 1)
        parts = self._parts_of(places) if shared else list(range(len(places)))
        sums = [
            self._sum(blobs, blobs & shared, part) if blobs else None
            for blobs, part in zip(touched, parts, strict=True)
        ]
        return [None if each is None else each.load(right_side, noise_std) for each in sums]

    def _sum(self, blobs: Blobs, divided: Blobs, part: int) -> "_ContactSum":
        """Sum over blobs that a contact touches; of those that are divided, over its part."""
        key = blobs, divided, part if divided else 0
        if key not in self._found:
            chosen = np.isin(self._blob_of, list(blobs))
            if divided:
                chosen &= ~np.isin(self._blob_of, list(divided)) | (self._parts == part)
            sums = (self._sums * chosen).reshape(6, -1)
            unit = np.abs(sums).max(axis=1, keepdims=True)
            unit[unit == 0.0] = 1.0  # of a single pixel about itself
            answers = unit * self._problem.solutions(sums / unit)  # a right side times these gives the sums, (6, 3 n)
            self._found[key] = _ContactSum(
                self._unit * sums @ answers.T * np.outer(_STD_FACTOR, _STD_FACTOR),
                answers,
                self._reference_m,
                self._centres_m[self._pixels[chosen]],
                self._area_m2,
            )
        return self._found[key]

    def _parts_of(self, places: Sequence[Indices]) -> list[int]:
        """Divide the problem's pixels between contacts; return the part that belongs to each."""
        members_m = self._centres_m[np.concatenate(places)]
        contact = np.repeat(np.arange(len(places)), [pixels.size for pixels in places])
        nearest = contact[cKDTree(members_m).query(self._centres_m[self._pixels])[1]]
        if self._parts.size:
            votes = [np.bincount(self._parts[nearest == index], minlength=1) for index in range(len(places))]
            parts = np.array([int(vote.argmax()) for vote in votes])
            if np.unique(parts).size == parts.size and np.mean(parts[nearest] != self._parts) < _DIVIDED_AGAIN:
                return [int(part) for part in parts]
        self._parts = nearest
        self._found = {key: found for key, found in self._found.items() if not key[1]}
        return list(range(len(places)))


class _ContactSum:
    """Load of one contact: its six sums over the pixels, about the origin."""

    def __init__(
        self, covariance: Floats, answers: Floats, reference_m: Floats, centres_m: Floats, area_m2: float
    ) -> None:
        """Initialise with sums (6, 6) and (6, 3 n) about a point of reference."""
        x, y = reference_m
        shift = np.eye(6)
        shift[_M_X, 2], shift[_M_Y, 2], shift[_M_Z, 0], shift[_M_Z, 1] = y, -x, -y, x
        self._answers = shift @ answers
        covariance = shift @ covariance @ shift.T
        self._variance = np.maximum(np.diag(covariance), 0.0)
        self._tilts = [float(covariance[i, k]) for i, k in ((2, 2), (2, 3), (2, 4), (3, 3), (4, 4))]
        self._radius_m = math.sqrt(area_m2 * len(centres_m) / math.pi)
        lever_m = math.sqrt(float(np.mean(np.sum(centres_m**2, axis=1))))
        self._pixel_variance = (_PIXEL_ERROR * np.repeat([1.0, lever_m], 3)) ** 2

    def load(self, right_side: Singles, noise_std: float) -> NetLoad:
        """Return the load in a frame; `noise_std` over that of the problem."""
        values = self._answers @ right_side
        force, moment = values[:3], values[3:]
        f_x, f_y, normal, m_x, m_y, _ = values.tolist()
        std = np.sqrt(self._variance * noise_std**2 + self._pixel_variance * (f_x**2 + f_y**2 + normal**2))
        x, y = -m_y / normal, m_x / normal
        # What a sum of f_z times the distance from the centroid scatters by.
        zz, zx, zy, xx, yy = self._tilts
        spread = x**2 * zz + 2.0 * x * zy + yy, y**2 * zz - 2.0 * y * zx + xx
        by_pixels = (_PIXEL_ERROR[_F_Z] * self._radius_m) ** 2
        centroid_std = [math.sqrt(max(part, 0.0) * (noise_std / normal) ** 2 + by_pixels) for part in spread]
        return NetLoad(force, std[:3], moment, std[3:], np.array([x, y]), np.array(centroid_std))


def _functionals(arms_m: Floats) -> Floats:
    """Sum forces x, y, z and moments x, y, z of unit areas of traction, (6, 3, n)."""
    x, y = arms_m.T
    sums = np.zeros((6, 3, x.size))
    sums[:3] = np.eye(3)[:, :, None]
    sums[3, 2], sums[4, 2] = y, -x
    sums[5, 0], sums[5, 1] = -y, x
    return sums
