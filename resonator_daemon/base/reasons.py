"""Reasons and states: closed sets of words with their meanings, and the sentences next to them."""

from enum import StrEnum
from typing import Any, NamedTuple, Self

from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema


class Word(StrEnum):
    """A word of a closed set, with what it means."""

    meaning: str

    def __new__(cls, word: str, meaning: str = "") -> Self:  # a look-up by word gives no meaning
        member = str.__new__(cls, word)
        member._value_ = word
        member.meaning = meaning
        return member

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        plain = handler.resolve_ref_schema(handler(schema))
        about = [plain["description"], *(f"- `{word}`: {word.meaning}" for word in cls)]
        plain["description"] = "\n".join(about)
        plain["x-enum-varnames"] = [word.name for word in cls]
        plain["x-enum-descriptions"] = [word.meaning for word in cls]
        return plain


class Condition(Word):
    """The words of the states of daemon, link, sensor and decoder."""

    OFFLINE = "offline", "not running: stopped, or ended without notice (last will)"
    STARTING = "starting", "on the way to online; nothing is wrong yet"
    ONLINE = "online", "working"
    WAITING = "waiting", "what it needs (port, board, network, frames) is not there; tried again for ever"
    STALLED = "stalled", "the link is open and nothing usable comes; of a skin also: its decoder ended"
    LOST = "lost", "was there and went away; tried again for ever"
    DRIFTING = "drifting", "the baseline moves faster than touches and temperature explain"
    PRESSED_AT_START = "pressed_at_start", "touched before the untouched plate was known; release it"
    UNCALIBRATED = "uncalibrated", "the calibration has expired"
    REFUSED = "refused", "the board or the plate file can never serve this configuration"


class ReasonCode(Word):
    """Why something is as it is; the sentence next to it has the details."""

    # States of the sensor.
    MEASURING = "measuring", "measures and publishes; nothing is wrong"
    NO_FRAMES = "no_frames", "no frame arrives; of a contact: none for half a second"
    BOARD_RESTARTED = "board_restarted", "the board restarted"
    DECODER_STARTING = "decoder_starting", "the decoder is being set up"
    NO_SIGNALS = "no_signals", "no signals that could be decoded"

    # States of decoders.
    STARTED = "started", "the process has started"
    DECODING = "decoding", "signals are decoded"
    STOPPED = "stopped", "ended by a user or a signal, or at the end of its work"
    CONNECTION_LOST = "connection_lost", "the connection to the broker broke: a last will"
    NO_INFO = "no_info", "no daemon has published under this name"
    INFO_UNUSABLE = "info_unusable", "the published plate cannot be used, or has no skin"
    DECODED_BY_DAEMON = "decoded_by_daemon", "the daemon decodes this plate itself"
    CANNOT_SHARE = "cannot_share", "the broker does not share messages among several decoders"
    DECODER_CRASHED = "decoder_crashed", "the decoder process ended, and is restarted"
    DECODER_HUNG = "decoder_hung", "the decoder process did not answer, and is restarted"
    UNDECODABLE = "undecodable", "no decoder is possible for these sites and options"

    # Daemons.
    NO_BOARD = "no_board", "no board sends frames: `state/link` has the reason"
    NAME_CONFLICT = "name_conflict", "another process publishes under the same name"
    BAD_CONFIGURATION = "bad_configuration", "the file cannot be used; an earlier configuration is in use"
    RESTART_NEEDED = "restart_needed", "changes of the file take effect at the next start"
    REPLAYING = "replaying", "a recording is replayed to the broker"

    # Links and boards.
    OPENING = "opening", "the link is being opened for the first time"
    NO_SUCH_PORT = "no_such_port", "the port or device is not there"
    PORT_IN_USE = "port_in_use", "another program holds the port, device or connection"
    PERMISSION_DENIED = "permission_denied", "this user may not open the port or device"
    PORT_UNUSABLE = "port_unusable", "the port or device cannot be opened for another reason"
    HOST_UNKNOWN = "host_unknown", "the name of the host was not found"
    HOST_UNREACHABLE = "host_unreachable", "nothing answers at the address of the host"
    CONNECTION_REFUSED = "connection_refused", "nothing listens on that port of the host"
    UNPLUGGED = "unplugged", "an open link ended: cable, device or connection"
    WRITE_TIMEOUT = "write_timeout", "the board accepted no bytes for a second"
    TRANSFERS_FAIL = "transfers_fail", "the USB transfers of an open device fail repeatedly"
    NO_BOARD_ANSWERS = "no_board_answers", "no board of this kind answers"
    NO_PONG = "no_pong", "no ping is answered; frames may come all the same"
    CONFIGURING = "configuring", "the board has answered and is being configured"
    BOARD_COUNTS = "board_counts", "the board acquires, and its frames arrive"
    TICK_RATE = "tick_rate", "as board_counts, but the ticks have another rate than it reports"
    BOARD_SILENT = "board_silent", "no frame for seconds; the link is opened again"
    BOARD_FAULT = "board_fault", "the board reports that it cannot count"
    CONFIGURATION_LOST = "configuration_lost", "the board no longer has its configuration"
    COMPUTER_BUSY = "computer_busy", "the daemon waits for a processor longer than it runs"
    CLOCK_JUMPED = "clock_jumped", "the board's ticks jumped without a restart"
    FRAME_LENGTH = "frame_length", "frames of another length are refused"
    FRAME_PART = "frame_part", "parts of frames that do not match are refused"
    FRAME_KIND = "frame_kind", "frames of another kind of counter are refused"
    FRAME_TICKS = "frame_ticks", "frames with ticks far from the pings' ticks are refused"
    MESSAGE_FIELDS = "message_fields", "messages with an impossible field are refused"
    WRONG_PROTOCOL = "wrong_protocol", "the board uses another protocol"
    WRONG_PLATE = "wrong_plate", "the board serves a plate of another kind"
    WRONG_COUNTER = "wrong_counter", "counter, channels or tones differ from the plate file"
    WRONG_REFERENCE = "wrong_reference", "the reference clock differs from the plate file"
    WRONG_GATE = "wrong_gate", "the board cannot make the gate that the plate file needs"
    WRONG_SERIAL_NUMBER = "wrong_serial_number", "the plate file was calibrated with another board"
    ANOTHER_BOARD = "another_board", "another board than before"
    CONFIGURATION_REFUSED = "configuration_refused", "the board refuses its configuration"
    RECORDING_UNUSABLE = "recording_unusable", "the recording cannot be read"
    RECORDING_OVER = "recording_over", "the recording that was replayed is over"
    DISK_FULL = "disk_full", "the disk is full, or has less free space than `min_free_mb`"
    WRITE_FAILED = "write_failed", "the file of the recording cannot be made or written"
    FILE_GONE = "file_gone", "the file of the recording was removed, moved or replaced"
    UNSPECIFIED = "unspecified", "see the sentence"

    # Releases of contacts.
    FORCE_FELL = "force_fell", "the force is below the threshold of release"
    NOT_DETECTED = "not_detected", "a reading that covers all touches has none there"
    UNKNOWN_TOO_LONG = "unknown_too_long", "the force was unknown for half a second"
    NOT_FOUND_ON_MAP = "not_found_on_map", "some decoded maps in a row do not show the contact"
    DECODER_RESET = "decoder_reset", "the decoder was set up again, for another noise"
    PLATE_CHANGED = "plate_changed", "the plate is another one, or was configured again"

    # Measurement.
    COMMON_MODE_PENDING = "common_mode_pending", "the common mode is being estimated; leave the plate untouched"
    WINDOW_NOT_FULL = "window_not_full", "channels have counted the present tone for less than a window"
    PRESSED_AT_START = "pressed_at_start", "touched before the untouched plate was known; release it"
    DRIFTING = "drifting", "the baseline moves faster than touches and temperature explain"
    UNCALIBRATED = "uncalibrated", "the calibration has expired; calibrate again"
    NO_TONE = "no_tone", "no tone is known"
    TOO_NOISY = "too_noisy", "noise hides touches"
    CHANNELS_SILENT = "channels_silent", "channels have no tone that can be counted"
    SITES_SILENT = "sites_silent", "some sites are not detected; the others are used"
    TOO_FEW_CHANNELS = "too_few_channels", "a tone of a site on one channel alone, at least two are needed"
    TOO_FEW_TONES = "too_few_tones", "too few tones are known to estimate the common mode"
    TONES_ALIKE = (
        "tones_alike",
        "two tones are about equally strong: several sites are touched, or one in between; "
        "also just when a site is touched or released",
    )
    SECOND_TONE = "second_tone", "a second tone is detected: a further site may be touched"
    CHANNEL_LEFT_OUT = "channel_left_out", "one channel detects another tone; the others agree on the site"
    SEVERAL_SITES = "several_sites", "channels detect different sites, all of which are reported"
    SITES_ALIKE = "sites_alike", "other sites explain the channels about as well"
    OVERLOAD_OR_SEVERAL = "overload_or_several", "one force beyond the range, or several sites"
    OVERLOAD = "overload", "a force beyond the range of the plate"
    CHANNELS_DISAGREE = "channels_disagree", "channels detect the same site and disagree on its force"
    NO_SITE_FITS = "no_site_fits", "no site explains the channels"
    NO_TOUCHES_FIT = "no_touches_fit", "no touches explain the forces of the sites"
    OTHER_SITE = "other_site", "another site is detected instead"

    # Decoding.
    DECODING_OFF = "decoding_off", "the configuration has decoding.method = off"
    DECODED_ELSEWHERE = "decoded_elsewhere", "another process is to decode: resonatord decode"
    DECODING_FAILED = "decoding_failed", "the decoder failed in this frame"
    SIGNALS_MISSING = "signals_missing", "too few signals are known"
    SIGNALS_LOST = "signals_lost", "some signals are missing and were filled in"
    SENSOR_SUSPECT = "sensor_suspect", "some sites contradict all others; after 10 s of load they are not used"
    SIGNALS_UNEXPLAINED = "signals_unexplained", "no surface explains the signals"
    MATRICES_PENDING = "matrices_pending", "matrices are being computed; a linear map is shown"
    SUPPORT_ENLARGED = "support_enlarged", "load was found outside the contact that the linear map shows"
    FRICTION_CONTRADICTED = "friction_contradicted", "the signals contradict the friction coefficient; it is not used"
    PHYSICS_CONTRADICTED = "physics_contradicted", "the signals contradict contact physics; the linear map is shown"
    SLIPS_TOO_LITTLE = "slips_too_little", "the contact slips too little to show; shear it more"
    NO_SLIP_MARGIN = "no_slip_margin", "a flat punch sticks as a whole until it slides"
    FRICTION_UNKNOWN = "friction_unknown", "the friction coefficient is known to worse than a quarter"
    NOT_FITTED = "not_fitted", "the contact was not fitted"
    FIT_UNDETERMINED = "fit_undetermined", "the signals do not determine the contact"
    FIT_REJECTED = "fit_rejected", "no single contact explains the signals"
    FIT_CONTRADICTED = (
        "fit_contradicted",
        "the signals contradict the model of the contact, errors exceed what is stated: calibrate the skin with a ball",
    )
    FORCE_INSIGNIFICANT = "force_insignificant", "the normal force is too small against its error"
    CONTACT_TOO_LARGE = "contact_too_large", "the contact is too large for its rim to show"

    @classmethod
    def _missing_(cls, value: object) -> "ReasonCode | None":
        """Return the code of a word that is none here, as one of a later version."""
        return cls.UNSPECIFIED if isinstance(value, str) else None


class Reason(NamedTuple):
    """A code, and a sentence with details.

    Reasons are compared by both; a program that reads messages compares the code alone.
    """

    code: ReasonCode
    text: str


def joined(*reasons: Reason | None) -> Reason | None:
    """Return several reasons as one: the sentences in their order, the most severe first, under the code of that."""
    stated = [reason for reason in reasons if reason is not None]
    if len(stated) < 2:
        return stated[0] if stated else None
    return Reason(stated[0].code, "; ".join(reason.text for reason in stated))
