"""Recipe of Spack. The checksum is that of a released sdist, of which there is none yet."""
# ruff: noqa: F403, F405
# mypy: disable-error-code="name-defined, call-arg"

from spack.package import *
from spack_repo.builtin.build_systems.python import PythonPackage


class PyMsmpetsc(PythonPackage):
    """Elastic bodies from closed surface meshes: solids and springs, by PETSc."""

    pypi = "msmpetsc/msmpetsc-0.2.0.tar.gz"
    license("BSD-3-Clause")

    version("0.2.0", sha256="0" * 64)

    variant("run", default=True, description="simulations, not only the reading of results")

    depends_on("python@3.11:", type=("build", "run"))
    depends_on("py-setuptools@77:", type="build")
    depends_on("py-numpy@1.24:", type=("build", "run"))
    depends_on("py-h5py@3.7:", type=("build", "run"))

    with when("+run"):
        depends_on("petsc+mumps+mpi", type=("build", "link", "run"))
        depends_on("py-petsc4py@3.18:", type=("build", "run"))
        depends_on("py-mpi4py@3.1:", type=("build", "run"))
        depends_on("py-scipy@1.10:", type=("build", "run"))
        depends_on("py-numba@0.59:", type=("build", "run"))
        depends_on("py-pydantic@2.6:", type=("build", "run"))
        depends_on("py-tomli-w@1.0:", type=("build", "run"))
        depends_on("py-pooch@1.7:", type=("build", "run"))
        depends_on("py-psutil@5.9:", type=("build", "run"))
        depends_on("py-tqdm@4.60:", type=("build", "run"))
        # Spack has no py-libigl and no py-trimesh@4. No variant can leave them out, for
        # nearly every scene needs both. Install them into the view:
        # python -m pip install "libigl>=2.5" "trimesh>=4.0"

    def test_version(self):
        """The installed command names its version."""
        msmpetsc = which(self.prefix.bin.msmpetsc)
        assert str(self.version) in msmpetsc("--version", output=str)
