"""Files on disk that survive a crash, whatever they contain."""

from evercal.storage.atomic import (
    recover_folder as recover_folder,
    replace_folder as replace_folder,
    write_bytes as write_bytes,
    write_json as write_json,
)
from evercal.storage.manifest import (
    MANIFEST as MANIFEST,
    Manifest as Manifest,
    read_manifest as read_manifest,
    sha256_file as sha256_file,
    verify as verify,
    write_manifest as write_manifest,
)
