#!/bin/sh
# Fills fuzz/corpus with small valid files, so that the fuzzers start from files that the readers accept.
set -eu
cd "$(dirname "$0")"
scene=../tests/golden/scene-mini
mkdir -p corpus/colmap_binary corpus/colmap_text corpus/ply corpus/scene_json corpus/image
i=0
for stem in cameras images points3D; do
    code="\\00$i"
    { printf "$code"; cat "$scene/sparse/binary/$stem.bin"; } >"corpus/colmap_binary/$stem"
    { printf "$code"; cat "$scene/sparse/text/$stem.txt"; } >"corpus/colmap_text/$stem"
    i=$((i + 1))
done
cp "$scene/scene/gaussians.ply" corpus/ply/
cp "$scene/scene/scene.json" corpus/scene_json/
cp "$scene/images/view_00.png" "$scene/exr/view_00.exr" corpus/image/
# One pixel in each format that the scene does not have.
printf '\223NUMPY\001\000\166\000{"descr": "<f4", "fortran_order": False, "shape": (1, 1), }                                                          \n\000\000\200\077' | tr '"' "'" >corpus/image/one.npy
printf 'II*\000\010\000\000\000\010\000\000\001\003\000\001\000\000\000\001\000\000\000\001\001\003\000\001\000\000\000\001\000\000\000\002\001\003\000\001\000\000\000\010\000\000\000\003\001\003\000\001\000\000\000\001\000\000\000\006\001\003\000\001\000\000\000\001\000\000\000\021\001\004\000\001\000\000\000\156\000\000\000\026\001\003\000\001\000\000\000\001\000\000\000\027\001\004\000\001\000\000\000\001\000\000\000\000\000\000\000\200' >corpus/image/one.tif
