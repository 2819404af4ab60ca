"""Files on disk that survive a crash, whatever they contain."""

from evercal.storage.atomic import recover_folder as recover_folder
from evercal.storage.atomic import replace_folder as replace_folder
from evercal.storage.atomic import write_bytes as write_bytes
from evercal.storage.atomic import write_json as write_json
from evercal.storage.manifest import MANIFEST as MANIFEST
from evercal.storage.manifest import Manifest as Manifest
from evercal.storage.manifest import read_manifest as read_manifest
from evercal.storage.manifest import sha256_file as sha256_file
from evercal.storage.manifest import verify as verify
from evercal.storage.manifest import write_manifest as write_manifest
