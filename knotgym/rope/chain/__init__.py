"""The chain engine: a fast solver for the closed rope, behind the interface `rope.interface`.

| module | holds |
| --- | --- |
| `chain_simulation` | many ropes stepped at once; to and from MuJoCo's qpos |
| `solver` | the loop over substeps: their lengths, acceptance and rejection |
| `dynamics` | the equations of motion of one substep |
| `layout` | what stands where in every packed array, with units and a drawing; the rope's numbers |
| `banded` | their linear system: factorization, substitution |
| `contact` | pairs of edges that touch, contact forces |
| `passage` | the proof that no strands passed |
| `simd` | several float64 as one value in compiled code |
| `vectors` | three of them as a vector |
"""
