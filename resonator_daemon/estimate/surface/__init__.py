"""From signals at depth back to what happens on the surface: maps, contacts, shape and slip."""

from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.parametric_decoder import ParametricDecoder
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, PartialSlip
from resonator_daemon.estimate.surface.fitting.shape import Shape, ShapeFitter
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipWatch, fit_partial_slip
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.patches import Patch, PatchFinder

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
