"""Masks of everything in a picture, and their boundaries."""

from calib_ros.semantics.segment_anything.anything import MaskEdges as MaskEdges
from calib_ros.semantics.segment_anything.anything import SegmentAnything as SegmentAnything
from calib_ros.semantics.segment_anything.mask_edges import mask_edges as mask_edges
from calib_ros.semantics.segment_anything.mask_folder import MaskFolder as MaskFolder
from calib_ros.semantics.segment_anything.masks import Mask as Mask
from calib_ros.semantics.segment_anything.masks import Masks as Masks
from calib_ros.semantics.segment_anything.masks import Segmenter as Segmenter
