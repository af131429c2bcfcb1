"""Precomputes a scene on a cluster with dask: change what is marked, and run it where jobs are submitted from.

    pip install jaxprt dask-jobqueue        # or dask-kubernetes
    python examples/cluster.py scene.glb /shared/scene

Workers write what they compute into the folder themselves if they see it; without a shared folder they send it to this
process. Stop the script, or lose workers, whenever you like: the same command goes on from there.
"""

import pathlib
import sys

import distributed

import jaxprt as prt


def cluster():
    """Change this: where workers come from."""
    # Slurm:
    #     from dask_jobqueue import SLURMCluster
    #     made = SLURMCluster(cores=1, processes=1, memory="4GB", walltime="02:00:00", queue="cpu")
    #     made.scale(jobs=64)
    # Kubernetes, with the operator installed and a volume for the folder in the image's pod template:
    #     from dask_kubernetes.operator import KubeCluster
    #     made = KubeCluster(name="jaxprt", image="your/image", n_workers=64)
    return distributed.LocalCluster(threads_per_worker=1)


def main(mesh: str, folder: str) -> None:
    """Makes the scene ready; without `system` a plan would be made first, on this machine."""
    if pathlib.Path(f"{folder}.saved").exists():
        print(f"{folder}.saved is finished")
        return
    with cluster() as workers, distributed.Client(workers) as client:
        relit = prt.precompute(prt.load_scene(mesh), system="lobe", path=folder, executor=client.get_executor())
    prt.files.save(f"{folder}.saved", relit)


if __name__ == "__main__":
    main(*sys.argv[1:])
