"""What a phone on the local network needs: an address, a certificate made on the spot, a code to scan."""

from __future__ import annotations

import io
import ipaddress
import os
import socket
import ssl
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from mambaloc.errors import InputError

_DAYS = 7


def lan_address() -> str:
    """This machine's address on the network that it reaches others by.

    Raises:
        InputError: where it is on none.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address of no machine; nothing is sent
            return str(probe.getsockname()[0])
        except OSError:
            raise InputError("--lan: this machine has no network. Join one, or leave --lan out.") from None


def self_signed(address: str) -> ssl.SSLContext:
    """A TLS context with a new key and certificate of this address, which are on the disk only while they are read.

    Raises:
        InputError: without the extra ``lan``.
    """
    _need("cryptography")
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "MambaLoc demo")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=_DAYS))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with TemporaryDirectory() as folder:  # its owner's alone
        file = Path(folder, "certificate.pem")
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
            out.write(pem + certificate.public_bytes(serialization.Encoding.PEM))
        context.load_cert_chain(file)
    return context


def qr_code(text: str) -> str:
    """A QR code as blocks for the terminal.

    Raises:
        InputError: without the extra ``lan``.
    """
    _need("segno")
    import segno

    out = io.StringIO()
    segno.make(text, error="l").terminal(out, compact=True)
    return out.getvalue()


def _need(package: str) -> None:
    try:
        import_module(package)
    except ImportError:
        raise InputError(f"--lan: needs the package {package}. Run pip install 'mambaloc[lan]'.") from None
