"""Certificate authority of a laboratory: X.509 v3 certificates and private keys in PEM.

Keys are ECDSA on P-256 with SHA-256 signatures, which every TLS 1.3 library supports. Extensions
follow RFC 5280: the authority has path length 0 and signs end-entity certificates only; these state
their key usage. Only this file imports `cryptography`.
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
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

AUTHORITY_DAYS, LEAF_DAYS = 3652, 365
MAX_CLOCK_SKEW = timedelta(hours=1)  # by which a verifying clock may be late


@dataclass(frozen=True, slots=True)
class CertificateKeyPair:
    """Certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes


def create_authority(name: str, valid_from: datetime) -> CertificateKeyPair:
    """Create a self-signed certificate authority, valid for ten years."""
    key = ec.generate_private_key(ec.SECP256R1())
    valid_until = valid_from + timedelta(days=AUTHORITY_DAYS)
    builder = _start_builder(name, key, _common_name(name), valid_from, valid_until)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_key_usage(signs_certificates=True), critical=True)
    return _to_key_pair(builder.sign(key, SHA256()), key)


def issue_certificate(
    authority: CertificateKeyPair, name: str, hosts: Sequence[str], valid_from: datetime
) -> CertificateKeyPair:
    """Issue a certificate for `name`, valid for a year; with `hosts` it may serve as one of them.

    Raises ValueError if the authority is damaged, or its key does not match its certificate.
    """
    authority_certificate = x509.load_pem_x509_certificate(authority.certificate)
    signer = load_pem_private_key(authority.key, None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != (
        authority_certificate.public_key()
    ):
        raise ValueError("the authority's key does not belong to its certificate")
    key = ec.generate_private_key(ec.SECP256R1())
    valid_until = min(
        valid_from + timedelta(days=LEAF_DAYS), authority_certificate.not_valid_after_utc
    )
    builder = _start_builder(name, key, authority_certificate.subject, valid_from, valid_until)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    builder = builder.add_extension(_key_usage(signs_certificates=False), critical=True)
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if hosts:
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
    # strict verifiers require a subject alternative name
    names = [_general_name(host) for host in hosts] or [
        x509.UniformResourceIdentifier(f"shaketwin:{name}")
    ]
    builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    issuer_key_id = authority_certificate.extensions.get_extension_for_class(
        x509.SubjectKeyIdentifier
    ).value
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(issuer_key_id),
        critical=False,
    )
    return _to_key_pair(builder.sign(signer, SHA256()), key)


def verify_certificate(certificate: bytes, authority: bytes, time: datetime) -> str:
    """Verify that the authority issued a client's certificate; return its common name.

    Raises ValueError if it did not, or if either is not valid at `time` (RFC 5280).
    """
    leaf, *intermediates = x509.load_pem_x509_certificates(certificate)
    policy = PolicyBuilder().store(Store(x509.load_pem_x509_certificates(authority))).time(time)
    try:
        policy.build_client_verifier().verify(leaf, intermediates)
    except VerificationError as error:
        raise ValueError(str(error)) from None
    names = leaf.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def certificate_validity(certificate: bytes) -> tuple[datetime, datetime]:
    """Return (valid from, valid until) in UTC of a PEM certificate; raise ValueError if damaged."""
    leaf = x509.load_pem_x509_certificate(certificate)
    return leaf.not_valid_before_utc, leaf.not_valid_after_utc


def certificate_hosts(certificate: bytes) -> list[str]:
    """Return the host names and addresses in a PEM certificate."""
    extensions = x509.load_pem_x509_certificate(certificate).extensions
    names = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return [str(name.value) for name in names if isinstance(name, x509.DNSName | x509.IPAddress)]


def _start_builder(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Name,
    valid_from: datetime,
    valid_until: datetime,
) -> x509.CertificateBuilder:
    """Start a certificate with the common fields and a random serial number of 159 bits."""
    public = key.public_key()
    return (
        x509.CertificateBuilder()
        .subject_name(_common_name(name))
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(valid_from - MAX_CLOCK_SKEW)
        .not_valid_after(valid_until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
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


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _to_key_pair(
    certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> CertificateKeyPair:
    return CertificateKeyPair(
        certificate.public_bytes(Encoding.PEM),
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
    )
