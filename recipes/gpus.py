"""What GPUs reach at most: the bounds of plans and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GPU:
    """Peak rates of a GPU, dense and without sparsity."""

    name: str
    bf16_flops: float
    """FLOP/s of bfloat16 matrix products that add up in float32."""
    bandwidth: float
    """Bytes per second of its memory."""
    memory: float
    """Bytes."""
    source: str

    def bound(self, flops: int, weight_bytes: int) -> float:
        """Seconds that no program goes below."""
        return max(flops / self.bf16_flops, weight_bytes / self.bandwidth)


GPUS = (
    GPU("H200", 989e12, 4.8e12, 141e9, "NVIDIA H200 Tensor Core GPU datasheet, SXM (1,979 TFLOPS with sparsity)"),
    GPU("H100", 989e12, 3.35e12, 80e9, "NVIDIA H100 Tensor Core GPU datasheet, SXM (1,979 TFLOPS with sparsity)"),
    GPU("A100", 312e12, 2.039e12, 80e9, "NVIDIA A100 80GB Tensor Core GPU datasheet, SXM"),
    GPU("RTX 4090", 165.2e12, 1.008e12, 24e9, "NVIDIA Ada GPU Architecture whitepaper, appendix A, FP32 accumulate"),
)
