"""Campaigns: the frames taken to assess one camera, how they are read, and where results are kept."""

from pixmetry.campaign.images import FrameReader, iter_frames, read_frame, write_frame
from pixmetry.campaign.in_memory import Frames, campaign_of_arrays
from pixmetry.campaign.manifest import EXAMPLE, load_campaign, photons_from_irradiance, write_manifest
from pixmetry.campaign.output import check_output, read_maps, staged_output, write_json, write_maps, write_record
from pixmetry.campaign.provenance import InputHashes, provenance_record
from pixmetry.campaign.records import CameraFacts, Campaign, FrameGroup, OpticsFacts
from pixmetry.campaign.staged_files import write_page

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
