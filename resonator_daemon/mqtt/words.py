"""Closed sets of words in the payloads of measurements, apart from states and statuses."""

from resonator_daemon.base.conditions import Word


class Baseline(Word):
    """How the frequencies of the untouched plate are known."""

    FOLLOWED = "followed", "from tones that nothing touches"
    HELD = "held", "as they were; no untouched tone is detected"
    UNKNOWN = "unknown", "not known yet"


class ResponseCompensation(Word):
    """Whether hysteresis and creep of the sites are taken out."""

    ON = "on", "hysteresis and creep are taken out"
    OFF = "off", "they were not calibrated; `systematic_newton` includes their typical size"


class CapturedTone(Word):
    """What tone a corner has captured."""

    NONE = "none", "no tone can be counted, or not for a whole window yet; `reason_code` states which"
    PILOT = "pilot", "that of the untouched plate"
    SITE = "site", "that of the site in `site`"
    UNIDENTIFIED = "unidentified", "another tone, which is not assigned to a site; the message's `status` states why"


class ContactChange(Word):
    """What happens to a contact."""

    ONSET = "onset", "it begins"
    RELEASE = "release", "it ends; `reason` states why"
    INCIPIENT_SLIP = "incipient_slip", "under a skin: its margin to slip has fallen below 0.3"
    GROSS_SLIP = "gross_slip", "under a skin: no margin is left, all of it slips"


class CounterType(Word):
    """Kind of the board's counter."""

    SINGLE_TONE = "single-tone", "one captured tone per corner"
    CHANNELISED = "channelised", "one tone per site and corner"
