"""Decoders: signals under a skin to traction, displacement, contacts and slip of its surface."""

from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder

__all__ = ["ContactDecoder", "Decoded", "DecodingOptions", "FourierDecoder", "OpenPlaneDecoder", "Skin", "SkinDecoder"]
