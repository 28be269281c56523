"""Decoders: signals under a skin to traction, displacement, contacts and slip of its surface."""

from resonator_daemon.estimate.surface import ContactDecoder, Decoded, FourierDecoder, OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder

__all__ = ["ContactDecoder", "Decoded", "DecodingOptions", "FourierDecoder", "OpenPlaneDecoder", "Skin", "SkinDecoder"]
