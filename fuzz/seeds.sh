#!/bin/sh
# Fills fuzz/corpus with small valid files, so that the fuzzers start from files that the readers accept.
set -eu
cd "$(dirname "$0")"
scene=../tests/golden/scene-mini
mkdir -p corpus/colmap_binary corpus/colmap_text corpus/ply corpus/scene_json corpus/image corpus/metashape corpus/nerfstudio corpus/opensfm corpus/realityscan corpus/exif
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
# One camera each of the formats that the scene is not in.
cat >corpus/metashape/one <<'END'
<document version="2.0.0"><chunk><sensors><sensor id="0" type="frame"><calibration class="adjusted"><resolution width="8" height="6"/><f>9</f><cx>1</cx><b2>1</b2><k4>1</k4><p1>1</p1></calibration></sensor></sensors><components><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>2</scale></transform></component></components><cameras><group label="g"><camera id="0" sensor_id="0" component_id="0" label="a"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></group></cameras><markers><marker id="0" label="m"><reference x="1" y="2" z="3"/></marker></markers><scalebars><scalebar label="s"><endpoint marker_id="0"/><endpoint marker_id="0"/><reference d="1"/></scalebar></scalebars><frames><frame><markers><marker marker_id="0"><location camera_id="0" x="1" y="2"/></marker></markers></frame></frames><reference>LOCAL_CS["a",UNIT["metre",1]]</reference></chunk></document>
ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 0 1
END
cat >corpus/nerfstudio/one.json <<'END'
{"w": 8, "h": 6, "fl_x": 9, "k1": 0.1, "applied_scale": 2, "frames": [{"file_path": "a.png", "mask_path": "m.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}
END
cat >corpus/opensfm/one <<'END'
[{"cameras": {"c": {"projection_type": "brown", "width": 8, "height": 6, "focal_x": 1, "focal_y": 1, "c_x": 0.1, "k1": 0.1, "p1": 0.1}}, "shots": {"a.jpg": {"camera": "c", "rotation": [0, 0, 1], "translation": [1, 2, 3]}}, "points": {"7": {"coordinates": [1, 2, 3], "color": [1, 2, 3]}}, "reference_lla": {"latitude": 1, "longitude": 2, "altitude": 3}}]a.jpg	7	0	0.1	0.2	0.01	1	2	3
END
cat >corpus/realityscan/table <<'END'
#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2
a.jpg,1,2,3,10,20,30,27,0.01,-0.02,-0.1,0.05,0,0,0.003,0
END
cat >corpus/realityscan/xmp <<'END'
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:Coordinates="absolute" xcr:DistortionModel="brown3" xcr:FocalLength35mm="27"><xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>1 2 3</xcr:Position><xcr:DistortionCoeficients>0.1 0 0 0 0 0</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>
END
printf '\377\330\377\341\000\042Exif\000\000II*\000\010\000\000\000\001\000\022\001\003\000\001\000\000\000\006\000\000\000\000\000\000\000\377\332\000\002' >corpus/exif/one.jpg
