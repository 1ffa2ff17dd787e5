"""The dense stage: from the photographs, depth and normals in every view, and from those the whole visible surface."""
