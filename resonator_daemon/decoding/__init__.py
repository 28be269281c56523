"""From signals at depth back to what happens on the surface: maps, contacts, shape and slip."""

from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.contact_start import ContactStart, Friction
from resonator_daemon.decoding.fitting.parametric_decoder import ParametricDecoder
from resonator_daemon.decoding.fitting.partial_slip import PartialSlip
from resonator_daemon.decoding.fitting.shape import Shape, ShapeFitter
from resonator_daemon.decoding.fitting.slip import SlipWatch
from resonator_daemon.decoding.fitting.slip_fitter import fit_partial_slip
from resonator_daemon.decoding.fourier.decoder import FourierDecoder
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.decoding.patches import Patch, PatchFinder

__all__ = [
    "ContactDecoder",
    "ContactStart",
    "Decoded",
    "DiscModel",
    "FourierDecoder",
    "Friction",
    "OpenPlaneDecoder",
    "ParametricDecoder",
    "PartialSlip",
    "Patch",
    "PatchFinder",
    "Shape",
    "ShapeFitter",
    "SlipWatch",
    "fit_partial_slip",
]
