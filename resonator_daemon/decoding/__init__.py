"""From signals at depth back to what happens on the surface: regularised inverses of the half-space's matrices."""

from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.fourier.decoder import FourierDecoder
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder

__all__ = ["ContactDecoder", "Decoded", "FourierDecoder", "OpenPlaneDecoder"]
