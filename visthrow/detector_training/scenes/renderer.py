"""Render pictures of scenes with Warp, on CPU or CUDA; reproducible to the bit on a device."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from camera.params import FisheyeParams
from visthrow.detector_training.scenes.scene import Scenes
from visthrow.detector_training.scenes.textures import photographs, pyramid


class Renderer:
    """A renderer of batches of scenes with a fixed picture size.

    Attributes:
        textures: number of photographs.
    """

    def __init__(
        self,
        lens: FisheyeParams,
        device: str = "cpu",
        files: list[Path] | None = None,
        samples: int = 6,
    ):
        """Load the photographs. Raises ValueError: no photographs.

        Args:
            lens: lens with the size of the pictures. device: "cpu" or "cuda:0".
            files: photographs; default those for training; with an empty list scenes are plain.
            samples: rays for each pixel.
        """
        import warp as wp

        from camera.warp_start import start

        start()
        self.lens = lens
        self.device = device
        self.samples = samples
        pixels = pyramid(photographs() if files is None else files)
        self.textures = len(pixels)
        self._pixels = wp.array(pixels, dtype=wp.uint8, device=device)

    def render(self, scenes: Scenes, seed: int = 0) -> torch.Tensor:
        """Return pictures, RGB, uint8, shape (E, H, W, 3), on the renderer's device.

        Args:
            scenes: the scenes; texture -1 is plain grey.
            seed: seed of the samples and of the sensor's noise.
        """
        import warp as wp

        from visthrow.detector_training.scenes.scene_kernel import SceneRow, ThingRow, render

        device = self.device
        p = self.lens
        image = torch.empty(scenes.count, p.height, p.width, 3, dtype=torch.uint8, device=device)
        *tables, things = vars(scenes.to(device)).values()
        table = torch.cat(tables, -1).float().contiguous()
        things = things.float().contiguous()

        def rows(tensor: torch.Tensor, struct: type) -> wp.array:
            """Return a view of a tensor whose last axis holds the fields of a struct."""
            shape = tensor.shape[:-1]
            return wp.array(ptr=tensor.data_ptr(), dtype=struct, shape=shape, device=device)

        def launch(part: slice) -> None:
            structs = (rows(table[part], SceneRow), rows(things[part], ThingRow))
            inputs = [seed, self.samples, *structs, self._pixels]
            outputs = [wp.from_torch(image[part])]
            wp.launch(render, image[part].shape[:3], inputs, outputs, device=device)

        if device.startswith("cuda"):
            torch.cuda.synchronize(device)  # Warp's stream is not torch's
            launch(slice(0, scenes.count))
            wp.synchronize_device(device)
            return image
        wp.load_module(device=device, module="visthrow.detector_training.scenes.scene_kernel")
        # on the CPU, Warp runs a launch in the calling thread
        share = -(-scenes.count // torch.get_num_threads())
        parts = (slice(first, first + share) for first in range(0, scenes.count, share))
        with ThreadPoolExecutor(torch.get_num_threads()) as threads:
            list(threads.map(launch, parts))
        return image
