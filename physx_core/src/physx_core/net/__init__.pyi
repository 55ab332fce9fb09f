"""Framed, authenticated TCP: what servers and clients of physx share."""

from .addresses import check_address as check_address
from .addresses import format_address as format_address
from .addresses import parse_address as parse_address
from .addresses import retry as retry
from .flat import flat_prefix as flat_prefix
from .frames import HEADER as HEADER
from .frames import MAX_PAYLOAD as MAX_PAYLOAD
from .frames import Frame as Frame
from .frames import FrameReader as FrameReader
from .frames import Kind as Kind
from .frames import header as header
from .frames import pack as pack
from .handshake import HANDSHAKE_LIMIT as HANDSHAKE_LIMIT
from .handshake import TOKEN_VARIABLE as TOKEN_VARIABLE
from .handshake import ServerHandshake as ServerHandshake
from .handshake import introduce as introduce
from .remote_errors import decode_error as decode_error
from .remote_errors import encode_error as encode_error
from .tokens import checked_token as checked_token
from .tokens import given_token as given_token
from .values import decode as decode
from .values import encode as encode
from .values import pack_value as pack_value
