"""X3P files (ISO 25178-72) of height maps: a zip archive with a description in XML and the heights in binary."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from semrecon.data import HeightMap

NAMESPACE = "http://www.opengps.eu/2008/ISO5436_2"
REVISION = "ISO5436 - 2000"
DATA = "bindata/data.bin"
CHECKSUM = "md5checksum.hex"
METRES_PER_UM = 1e-6


def write_x3p(path: Path, heights: HeightMap) -> None:
    """Write a height map in metres as 64 bit floats; missing heights are NaN.

    x grows fastest in the data and the frame is right-handed, so y points up in the image and its lowest row is first.
    """
    data = np.ascontiguousarray(heights.z_um[::-1] * METRES_PER_UM, dtype="<f8").tobytes()
    description = _description(heights, _md5(data))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("main.xml", description)
        archive.writestr(DATA, data)
        archive.writestr(CHECKSUM, f"{_md5(description)} *main.xml\n")


def _description(heights: HeightMap, checksum: str) -> bytes:
    """Record 1 says what is measured, record 3 where the data lie, record 4 where the checksum of all this lies."""
    rows, columns = heights.z_um.shape
    pitch = f"{heights.pixel_size_um * METRES_PER_UM:.12g}"
    ElementTree.register_namespace("p", NAMESPACE)
    root = ElementTree.Element(f"{{{NAMESPACE}}}ISO5436_2")
    measured = _add(root, "Record1", {"Revision": REVISION, "FeatureType": "SUR"})
    axes = _add(measured, "Axes", {})
    for axis in ("CX", "CY"):
        _add(axes, axis, {"AxisType": "I", "DataType": "D", "Increment": pitch, "Offset": "0"})
    _add(axes, "CZ", {"AxisType": "A", "DataType": "D", "Increment": "1", "Offset": "0"})
    content = _add(root, "Record3", {})
    _add(content, "MatrixDimension", {"SizeX": str(columns), "SizeY": str(rows), "SizeZ": "1"})
    _add(content, "DataLink", {"PointDataLink": DATA, "MD5ChecksumPointData": checksum})
    _add(root, "Record4", {"ChecksumFile": CHECKSUM})
    document: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return document


def _add(parent: ElementTree.Element, name: str, texts: dict[str, str]) -> ElementTree.Element:
    """Append an element with one child a text; only the root has a namespace in this format."""
    element = ElementTree.SubElement(parent, name)
    for key, text in texts.items():
        ElementTree.SubElement(element, key).text = text
    return element


def _md5(content: bytes) -> str:
    """Digest that the format asks for, against damage and not against malice."""
    return hashlib.md5(content, usedforsecurity=False).hexdigest()
