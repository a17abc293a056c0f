"""The bridge to policies that live in another environment: the messages, and the server that answers them.

Copy this folder into the policy's environment: it needs Python 3.10, NumPy and safetensors, and nothing of this
package (its imports are relative for that). A server there is a function ``act(images, state, instructions)`` and a
:class:`Description`, given to :func:`serve`; the other side is :class:`~worldenv_trl.policies.ExternalPolicy`. The
protocol is described in ``README.md`` of the folder above.
"""

from .description import ActionUnits, Description
from .messages import PROTOCOL_VERSION, ProtocolError, VersionError, receive_message, send_message, socket_address
from .server import PolicyServer, serve

__all__ = [
    "PROTOCOL_VERSION",
    "ActionUnits",
    "Description",
    "PolicyServer",
    "ProtocolError",
    "VersionError",
    "receive_message",
    "send_message",
    "serve",
    "socket_address",
]
