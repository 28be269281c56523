"""Types of ROS messages: those that come with ROS, and `resonator_msgs` for what ROS has no type for."""

import re
from typing import Any, Final

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install

try:
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:
    raise MissingLibraryError(f"messages of ROS 2 need rosbags: {how_to_install('rosbags')}") from error

__all__ = ["Nodetype", "Typestore", "make_typestore", "ros_name"]

CONTACT, CONTACTS, EVENT, FORCES, SITE_FORCE, SUMMARY, PATCH = (
    f"resonator_msgs/msg/{name}"
    for name in ("Contact", "Contacts", "ContactEvent", "Forces", "SiteForce", "DecodedSummary", "Patch")
)
WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"

# docs/examples/ros2/resonator_msgs is the same as a package of ROS. Names are those of the payloads.
DEFINITIONS: Final = {
    CONTACT: """\
uint64 id
string frame_id
uint32 site
float64[2] position_m
float64[3] position_covariance_m2
float64[3] force_newton
float64[3] noise_newton
float64[3] moment_newton_m
float64[3] moment_std_newton_m
float64 systematic_newton
float64 at_least_newton
float64 slip_margin
float64 slip_margin_std
float64 friction_coefficient
float64 friction_coefficient_std
string slip_reason_code
string status
string reason_code
""",
    CONTACTS: """\
std_msgs/Header header
string status
string reason_code
resonator_msgs/Contact[] contacts
""",
    EVENT: """\
std_msgs/Header header
string event
string reason_code
string reason
resonator_msgs/Contact contact
float64 peak_newton
builtin_interfaces/Time since
float64 duration_s
""",
    SITE_FORCE: """\
uint32 site
float64 force_newton
float64 noise_newton
float64 systematic_newton
float64 unobserved_bound_newton
float64 at_least_newton
string status
""",
    FORCES: """\
std_msgs/Header header
float64 window_s
string status
string reason_code
string reason
resonator_msgs/SiteForce[] sites
""",
    PATCH: """\
uint64 id
float64 area_m2
bool at_border
float64 radius_of_curvature_m
float64 stick_ratio
""",
    SUMMARY: """\
std_msgs/Header header
string decoder
float64 chi2
bool border_contact
string status
string reason_code
string reason
resonator_msgs/Patch[] patches
""",
}


def make_typestore(*, humble: bool = False) -> Typestore:
    """Return the types of ROS 2 and `resonator_msgs`; with `humble`, ids of nodes have the length of Humble."""
    store = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for kind, definition in DEFINITIONS.items():
        types |= get_types_from_msg(definition, kind)
    store.register(types)
    return store


def ros_name(text: str) -> str:
    """Return the text as a name that ROS accepts: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if re.match(r"[A-Za-z]", name) else f"plate_{name}"
