"""All that is on disk: manifests, image formats, provenance, and results that are written whole or not at all.

Paths enter; campaigns and frames leave. Records and maps enter; a sealed result leaves.
"""

from pixmetry.files.images import FrameReader, iter_frames, read_frame, write_frame
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.files.manifest import EXAMPLE, load_campaign, photons_from_irradiance, write_manifest
from pixmetry.files.output import check_output, staged_output, write_page
from pixmetry.files.provenance import InputHashes, provenance_record
from pixmetry.files.records import CameraFacts, Campaign, FrameGroup, OpticsFacts
from pixmetry.files.results import read_maps, write_json, write_maps, write_record

__all__ = [
    "EXAMPLE",
    "CameraFacts",
    "Campaign",
    "FrameGroup",
    "FrameReader",
    "Frames",
    "InputHashes",
    "OpticsFacts",
    "campaign_of_arrays",
    "check_output",
    "iter_frames",
    "load_campaign",
    "photons_from_irradiance",
    "provenance_record",
    "read_frame",
    "read_maps",
    "staged_output",
    "write_frame",
    "write_json",
    "write_manifest",
    "write_maps",
    "write_page",
    "write_record",
]
