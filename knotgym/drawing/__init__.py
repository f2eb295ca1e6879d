"""Draw ropes from Gauss codes: planar map, circle packing, layout relaxation, lifting."""
