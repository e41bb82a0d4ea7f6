"""The file of `encoder.backbone = path`: whether it is there, and which one it is."""

from pathlib import Path

from slotfilm_dist.atomic import file_digest
from slotfilm_dist.config import EncoderConfig


def weights_file_sha256(encoder: EncoderConfig) -> str:
    """SHA-256 of the file of initial weights.

    Raises:
        ValueError: it cannot be read, or is not the one that `encoder.backbone_sha256` names.
    """
    where = f"encoder.backbone_path = {encoder.backbone_path!r}"
    path = Path(encoder.backbone_path)
    if not path.is_file():
        raise ValueError(f"{where}: there is no such file")
    try:
        found = file_digest(path).sha256
    except OSError as error:
        raise ValueError(f"{where} cannot be read: {error.strerror}") from None
    if encoder.backbone_sha256 not in ("", found):
        raise ValueError(
            f"{where} is not the file that encoder.backbone_sha256 names: its SHA-256 is {found}, not "
            f"{encoder.backbone_sha256}; put the earlier file back, or start a new run with this one"
        )
    return found
