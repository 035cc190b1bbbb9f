"""The map's layers for other programs: TileJSON 3.0 of one, and WMTS 1.0.0 capabilities of all (OGC 07-057r7).

Addresses in them are those by which the program came, with its token if it sent one in the address.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final
from urllib.parse import quote
from xml.etree.ElementTree import Element

from fastapi import HTTPException, Request, Response

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.web.answers import JsonAnswer
from orthoswarm.export.xml_elements import element, xml_bytes
from orthoswarm.model.earth import WEB_MERCATOR_M

_GRID: Final = "GoogleMapsCompatible"
_TILE_PX: Final = 256
_PIXEL_M: Final = 0.00028  # the standard's pixel of a screen, to which scale denominators refer
_WORLD: Final = (-180.0, -85.0511, 180.0, 85.0511)


class MapServices:
    """The routes; `daemon`: whose layers they describe."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon

    def tilejson(self, request: Request, layer: str) -> Response:
        """A layer as TileJSON 3.0, for web maps and QGIS; `version` is that of its content."""
        row = next((row for row in self._daemon.views.layers() if row["name"] == layer), None)
        if row is None:
            raise HTTPException(404, "there is no such layer; see /api/layers")
        west, south, east, north = row["bounds"] or _WORLD
        return JsonAnswer({
            "tilejson": "3.0.0", "name": layer, "version": f"{row['version']}.0.0", "scheme": "xyz",
            "attribution": row.get("attribution", ""),
            "tiles": [_tiles(request, layer, "{z}/{x}/{y}")], "minzoom": 0, "maxzoom": row["maxzoom"],
            "bounds": [west, south, east, north],
            "center": [0.5 * (west + east), 0.5 * (south + north), min(17, row["maxzoom"])],
        })  # fmt: skip

    def wmts(self, request: Request) -> Response:
        """All layers as WMTS 1.0.0 capabilities (RESTful tiles, GoogleMapsCompatible)."""
        rows = [row for row in self._daemon.views.layers() if row["bounds"]]
        zooms = range(max((row["maxzoom"] for row in rows), default=22) + 1)
        layers = [_layer(row, _tiles(request, row["name"], "{TileMatrix}/{TileCol}/{TileRow}")) for row in rows]
        content = element("Contents", *layers, _matrix_set(zooms))
        service = element(
            "ows:ServiceIdentification",
            *_texts({"ows:Title": "OrthoSwarm", "ows:ServiceType": "OGC WMTS", "ows:ServiceTypeVersion": "1.0.0"}),
        )
        spaces = {"xmlns": "http://www.opengis.net/wmts/1.0", "xmlns:ows": "http://www.opengis.net/ows/1.1",
                  "xmlns:xlink": "http://www.w3.org/1999/xlink", "version": "1.0.0"}  # fmt: skip
        return Response(xml_bytes(element("Capabilities", service, content, **spaces)), media_type="application/xml")


def _tiles(request: Request, layer: str, place: str) -> str:
    """The address of a layer's tiles, with names in braces for their numbers."""
    token = request.query_params.get("token", "")
    return f"{request.base_url}tiles/{layer}/{place}.png" + (f"?token={quote(token, safe='')}" if token else "")


def _layer(row: Mapping[str, Any], template: str) -> Element:
    west, south, east, north = row["bounds"]
    box = {"ows:LowerCorner": f"{west:.9f} {south:.9f}", "ows:UpperCorner": f"{east:.9f} {north:.9f}"}
    return element(
        "Layer",
        *_texts({"ows:Title": row["name"]}),
        element("ows:WGS84BoundingBox", *_texts(box)),
        *_texts({"ows:Identifier": row["name"]}),
        element("Style", *_texts({"ows:Identifier": "default"}), isDefault="true"),
        *_texts({"Format": "image/png"}),
        element("TileMatrixSetLink", *_texts({"TileMatrixSet": _GRID})),
        element("ResourceURL", format="image/png", resourceType="tile", template=template),
    )


def _matrix_set(zooms: Sequence[int]) -> Element:
    half = 0.5 * WEB_MERCATOR_M
    crs = {"ows:Identifier": _GRID, "ows:SupportedCRS": "urn:ogc:def:crs:EPSG::3857"}
    matrices = [
        element("TileMatrix", *_texts({
            "ows:Identifier": str(zoom),
            "ScaleDenominator": repr(WEB_MERCATOR_M / _TILE_PX / 2**zoom / _PIXEL_M),
            "TopLeftCorner": f"{-half!r} {half!r}", "TileWidth": str(_TILE_PX), "TileHeight": str(_TILE_PX),
            "MatrixWidth": str(2**zoom), "MatrixHeight": str(2**zoom),
        }))
        for zoom in zooms
    ]  # fmt: skip
    return element("TileMatrixSet", *_texts(crs), *matrices)


def _texts(by_tag: Mapping[str, str]) -> list[Element]:
    return [element(tag, text) for tag, text in by_tag.items()]
