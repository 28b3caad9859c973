"""A small certificate authority, X.509 version 3 in PEM. The only file with `cryptography`.

Keys are ECDSA on P-256, signatures SHA-256: what every TLS 1.3 library takes. Extensions after RFC
5280: an authority says that it is one and signs leaves only (path length 0), a leaf that it is none
and what it is for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from ipaddress import ip_address

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from table_io.card import BadInput

AUTHORITY_DAYS, LEAF_DAYS = 3652, 365
SKEW = timedelta(hours=1)  # by which a clock of the laboratory may be late


@dataclass(frozen=True, slots=True)
class Pair:
    """A certificate and its private key, PEM."""

    certificate: bytes
    key: bytes


def found(name: str, now: datetime) -> Pair:
    """A new authority: it signs its own certificate, good for ten years."""
    key = ec.generate_private_key(ec.SECP256R1())
    until = now + timedelta(days=AUTHORITY_DAYS)
    builder = _begin(name, key, _named(name), now, until)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    return _pair(builder.sign(key, SHA256()), key)


def issue(authority: Pair, name: str, hosts: Sequence[str], now: datetime) -> Pair:
    """A certificate of `name`, good for a year; with `hosts` it may answer as one of them.

    BadInput where the authority has expired, or its key is another's.
    """
    above = x509.load_pem_x509_certificate(authority.certificate)
    signer = load_pem_private_key(authority.key, None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != (
        above.public_key()
    ):
        raise BadInput("the authority's key does not belong to its certificate; restore the two")
    ends = above.not_valid_after_utc
    if now >= ends:
        raise BadInput(
            f"the authority expired on {ends:%Y-%m-%d}; make new ones: `shaketwin keys new`"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    until = min(now + timedelta(days=LEAF_DAYS), ends)
    builder = _begin(name, key, above.subject, now, until)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if hosts:
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
    # strict readers want another name than the common one in every leaf
    names = [_host(host) for host in hosts] or [x509.UniformResourceIdentifier(f"shaketwin:{name}")]
    builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    of = above.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(of), critical=False
    )
    return _pair(builder.sign(signer, SHA256()), key)


def expiry(certificate: bytes) -> datetime:
    """Until when a certificate (PEM) is good, UTC; ValueError where it is none."""
    return x509.load_pem_x509_certificate(certificate).not_valid_after_utc


def hosts_of(certificate: bytes) -> list[str]:
    """The hosts that a certificate (PEM) may answer as."""
    extensions = x509.load_pem_x509_certificate(certificate).extensions
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [str(one.value) for one in names if isinstance(one, x509.DNSName | x509.IPAddress)]


def _begin(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Name,
    now: datetime,
    until: datetime,
) -> x509.CertificateBuilder:
    """What every certificate has; the serial number is random, 159 bits."""
    public = key.public_key()
    return (
        x509.CertificateBuilder()
        .subject_name(_named(name))
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Pair:
    return Pair(
        certificate.public_bytes(Encoding.PEM),
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
    )
