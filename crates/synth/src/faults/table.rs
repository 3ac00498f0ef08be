//! The list of all faults.

use super::fault::{
    CaptureFault,
    Due::{self, Minor, Note, Refused, Right, Serious},
    Strengths,
};
use super::folder::{Done, Spoiler};
use super::{bytes, frames, masks, measures, model, names, photographs};

type Spoil = fn(&Spoiler<'_>) -> Done;

/// A fault without strengths.
const fn plain(
    name: &'static str,
    carrier: &'static str,
    due: Due,
    wrong: &'static str,
    spoil: Spoil,
) -> CaptureFault {
    CaptureFault { name, carrier, wrong, strengths: None, due, spoil }
}

impl CaptureFault {
    /// The fault with strengths: weak, middle and strong.
    const fn of(self, unit: &'static str, values: [f64; 3]) -> Self {
        Self { strengths: Some(Strengths { unit, values }), ..self }
    }
}

/// Every fault, by the kind of file that carries it.
pub static FAULTS: &[CaptureFault] = &[
    // The model's poses, points and tracks.
    plain(
        "poses-turned",
        "model",
        Serious,
        "Every camera looks beside its true direction.",
        model::turn_poses,
    )
    .of("degrees", [0.15, 1.0, 6.0]),
    plain(
        "poses-shifted",
        "model",
        Serious,
        "Every camera stands beside its true place.",
        model::shift_poses,
    )
    .of("% of the swim", [0.8, 2.0, 6.0]),
    plain("pose-turned", "model", Minor, "One camera looks beside its true direction.", model::turn_one)
        .of("degrees", [4.0, 10.0, 40.0]),
    plain("stray-camera", "model", Minor, "One camera of the model stands far away.", model::stray_camera)
        .of("lengths of the swim", [10.0, 1000.0, 50_000.0]),
    plain("nan-pose", "model", Refused, "One camera's position is not a number.", model::nan_pose),
    plain("points-far", "model", Note, "20 points lie a million units away.", model::far_points),
    plain("nan-point", "model", Minor, "One point's position is not a number.", model::nan_point),
    plain(
        "errors-false",
        "model",
        Note,
        "The model states errors of 0.01 pixels, which its points do not have.",
        model::false_errors,
    ),
    plain(
        "points-scaled",
        "model",
        Serious,
        "The points were scaled after the model was made, the cameras were not.",
        model::scale_points,
    )
    .of("%", [16.0, 25.0, 40.0]),
    plain("tracks-mixed", "model", Serious, "Points lie where other points are.", model::mix_tracks)
        .of("share of the points", [0.15, 0.4, 0.8]),
    plain(
        "keypoints-shaken",
        "model",
        Serious,
        "Keypoints lie beside their features.",
        model::shake_keypoints,
    )
    .of("pixels", [1.5, 3.0, 6.0]),
    plain(
        "point-colours",
        "model",
        Note,
        "Red and blue of the points are exchanged.",
        model::swapped_point_colors,
    ),
    plain("no-tracks", "model", Serious, "The model does not say which view sees a point.", model::no_tracks),
    plain("few-views", "model", Serious, "There are only a few photographs.", model::few_views)
        .of("photographs", [8.0, 5.0, 3.0]),
    plain("no-overlap", "model", Serious, "Views overlap only in pairs.", model::no_overlap),
    plain("two-models", "model", Minor, "Each half of the swim has a model of its own.", model::two_models),
    plain(
        "two-parts",
        "model",
        Serious,
        "One model has two parts that share no point, and one part lies elsewhere.",
        model::two_parts,
    )
    .of("lengths of the swim", [0.3, 1.5, 8.0]),
    plain(
        "camera-turns",
        "model",
        Serious,
        "The camera turns on one place, so no distance is known.",
        model::camera_turns,
    ),
    plain("camera-stands", "model", Serious, "The camera does not move at all.", model::camera_stands),
    plain(
        "one-line",
        "model",
        Refused,
        "images.txt has one line for each image in place of two.",
        model::single_lines,
    ),
    plain("text-mark", "model", Right, "images.txt begins with a byte order mark.", model::text_with_mark),
    // Its lens.
    plain("focal-length", "lens", Serious, "The focal length is wrong.", model::focal_length)
        .of("%", [3.0, 8.0, 25.0]),
    plain("principal-point", "lens", Serious, "The centre of the picture is wrong.", model::principal_point)
        .of("% of the width", [1.5, 5.0, 12.0]),
    plain(
        "distortion",
        "lens",
        Serious,
        "The lens bends straight lines, and the model says that it does not.",
        model::distortion,
    )
    .of("first radial term", [0.05, 0.15, 0.4]),
    plain(
        "half-size-lens",
        "lens",
        Serious,
        "Lens and keypoints are those of photographs of half the size.",
        model::half_size,
    ),
    // The pixels.
    plain(
        "names-shuffled",
        "names",
        Serious,
        "Photographs have the names of others.",
        model::shuffle_photographs,
    )
    .of("share of the photographs", [0.17, 0.5, 1.0]),
    plain("turned-180", "photographs", Serious, "Photographs stand upside down.", photographs::upside_down)
        .of("share of the photographs", [0.1, 0.34, 1.0]),
    plain(
        "turned-90",
        "photographs",
        Minor,
        "Two photographs were turned by a quarter.",
        photographs::quarter_turn,
    ),
    plain(
        "square-turned-90",
        "photographs",
        Serious,
        "Square photographs were all turned by a quarter.",
        photographs::square_turn,
    ),
    plain("mirrored", "photographs", Serious, "Photographs are mirrored.", photographs::mirrored),
    plain(
        "smaller",
        "photographs",
        Note,
        "Photographs were made smaller after the model was made.",
        photographs::smaller,
    )
    .of("% of their size", [75.0, 60.0, 40.0]),
    plain(
        "cropped",
        "photographs",
        Serious,
        "A border was cut off, and the rest was enlarged to the old size.",
        photographs::cropped,
    )
    .of("%", [4.0, 10.0, 25.0]),
    plain("red-blue", "photographs", Serious, "Red and blue are exchanged.", photographs::swapped_colors),
    plain("grey", "photographs", Minor, "Half of the photographs are grey.", photographs::grey),
    plain(
        "exposure-drift",
        "photographs",
        Minor,
        "The exposure drifts along the swim.",
        photographs::exposure_drift,
    )
    .of("stops", [0.6, 1.5, 3.0]),
    plain("exposure-jumps", "photographs", Serious, "The exposure jumps.", photographs::exposure_jumps)
        .of("stops", [0.07, 0.5, 1.5]),
    plain("rig-exposure", "photographs", Serious, "One of two cameras is brighter.", photographs::rig)
        .of("stops", [0.04, 0.7, 2.0]),
    plain("balance-jumps", "photographs", Serious, "The white balance jumps.", photographs::balance_jumps)
        .of("%", [12.0, 25.0, 60.0]),
    plain("blurred", "photographs", Serious, "Every third photograph is blurred.", photographs::blurred)
        .of("pixels", [1.2, 2.0, 5.0]),
    plain("noisy", "photographs", Minor, "Photographs are full of grain.", photographs::noisy)
        .of("% of white", [8.0, 16.0, 30.0]),
    plain("black", "photographs", Minor, "One photograph is black.", photographs::black),
    plain("haze", "photographs", Serious, "Hardly any light of the reef arrives.", photographs::haze)
        .of("% of the light", [40.0, 15.0, 3.0]),
    plain("bars", "photographs", Note, "Black bars lie above and below.", photographs::bars)
        .of("% of the height", [2.0, 8.0, 20.0]),
    plain(
        "display",
        "photographs",
        Note,
        "The text of a display lies over the picture.",
        photographs::display,
    )
    .of("% of the picture", [3.0, 10.0, 20.0]),
    plain("port-rim", "photographs", Note, "The port's black rim is in the corners.", photographs::rim)
        .of("% of the half diagonal", [6.0, 16.0, 30.0]),
    plain("gripper", "photographs", Note, "A gripper stands still in every view.", photographs::gripper)
        .of("% of the height", [20.0, 45.0, 80.0]),
    plain("fish", "photographs", Minor, "Fish swim through every view, without masks.", photographs::fish)
        .of("fish", [1.0, 4.0, 12.0]),
    plain("same-twice", "photographs", Minor, "Photographs are there twice.", model::duplicates)
        .of("share of the photographs", [0.1, 0.5, 1.0]),
    // The form of the files.
    plain("adobe-rgb", "files", Note, "TIFF photographs are in Adobe RGB, and say so.", bytes::adobe_rgb),
    plain(
        "prophoto-rgb",
        "files",
        Note,
        "PNG photographs are in ProPhoto RGB, and say so.",
        bytes::pro_photo,
    ),
    plain("display-p3", "files", Note, "JPEG photographs are in Display P3, and say so.", bytes::display_p3),
    plain("few-bits", "files", Minor, "16-bit files use only their lower bits.", bytes::few_bits)
        .of("bits", [14.0, 12.0, 10.0]),
    plain("linear-exr", "files", Minor, "EXR photographs hold linear light.", bytes::linear_exr),
    plain("linear-png", "files", Note, "PNG photographs hold linear light, and say so.", bytes::linear_png),
    plain(
        "turn-tag",
        "files",
        Note,
        "EXIF data ask for a quarter turn, but the model has the photographs as they are stored.",
        bytes::turned_tag,
    ),
    plain(
        "upside-down-tag",
        "files",
        Serious,
        "Photographs are stored upside down with a tag; the model has them as a viewer shows them.",
        bytes::upside_down_with_tag,
    ),
    plain("cut-off", "files", Minor, "One JPEG file ends too early.", bytes::cut_off),
    plain("no-end", "files", Right, "JPEG files lack their last two bytes.", bytes::no_end),
    plain("empty-file", "files", Minor, "One photograph has no bytes.", bytes::empty_file),
    plain("other-format", "files", Minor, "One file is HEIC, and its name says PNG.", bytes::other_format),
    plain("missing-file", "files", Minor, "One photograph of the model is not there.", bytes::missing_file),
    // Names.
    plain("prefix", "names", Note, "The model says images/NAME for NAME.", names::leading_folder),
    plain("card-folder", "names", Note, "The model names the card's folder too.", names::card_folder),
    plain("full-path", "names", Note, "The model names folders of another computer.", names::full_path),
    plain("extension", "names", Note, "The model says .JPG, and the files are .png.", names::extension),
    plain("letter-case", "names", Note, "The model has the names in capital letters.", names::letter_case),
    plain("unicode-form", "names", Right, "Umlauts have two forms, as after a Mac.", names::unicode_form),
    plain("no-zeros", "names", Right, "Photographs are called 1, 2, … 10, without zeros.", names::no_zeros),
    plain("patterns", "names", Right, "Names hold %20 and %d.", names::patterns),
    plain(
        "ambiguous",
        "names",
        Refused,
        "Two folders have photographs of the same names, and the model names no folder.",
        names::ambiguous,
    ),
    // Masks.
    plain("masks-inverted", "masks", Serious, "Masks are white where the diver is.", masks::inverted),
    plain("masks-zero-one", "masks", Right, "Masks have the values 0 and 1.", masks::zero_one),
    plain("masks-black", "masks", Serious, "Masks hide everything.", masks::all_black),
    plain("masks-alpha", "masks", Right, "Masks are in the alpha channel of their files.", masks::in_alpha),
    plain("folder-mask", "masks", Note, "Masks lie in mask/.", masks::folder_mask),
    plain("folder-masks-capital", "masks", Note, "Masks lie in Masks/.", masks::folder_masks),
    plain("masks-beside", "masks", Note, "NAME_mask.png lies beside each photograph.", masks::beside),
    plain(
        "masks-beside-whole",
        "masks",
        Note,
        "NAME.png.mask.png lies beside each photograph.",
        masks::beside_with_extension,
    ),
    plain("masks-misnamed", "masks", Serious, "No mask has the name of a photograph.", masks::misnamed),
    plain(
        "masks-turned",
        "masks",
        Note,
        "Masks were painted on the pictures that EXIF data turn.",
        masks::turned,
    ),
    // Depth maps.
    plain(
        "depth-metric",
        "depth",
        Note,
        "Depth maps hold millimetres: farther is larger.",
        measures::metric_depth,
    ),
    plain("depth-coarse", "depth", Minor, "Depth maps have only a few steps.", measures::coarse_depth)
        .of("steps", [24.0, 8.0, 3.0]),
    plain("depth-shuffled", "depth", Serious, "Depth maps belong to other views.", measures::shuffled_depth)
        .of("share of the maps", [0.2, 0.5, 1.0]),
    plain("depth-empty", "depth", Minor, "One depth map has no bytes.", measures::empty_depth),
    // Positions.
    plain(
        "positions-wander",
        "positions",
        Note,
        "Positions wander as GPS fixes do.",
        measures::wandering_positions,
    )
    .of("metres", [2.0, 4.0, 8.0]),
    plain(
        "gps-wanders",
        "positions",
        Note,
        "GPS positions in the photographs wander.",
        measures::wandering_gps,
    )
    .of("metres", [2.0, 4.0, 8.0]),
    plain("positions-degrees", "positions", Note, "Positions are in degrees.", measures::degrees),
    plain(
        "positions-swapped",
        "positions",
        Note,
        "The axes of positions are exchanged.",
        measures::swapped_axes,
    ),
    plain(
        "positions-feet",
        "positions",
        Refused,
        "Positions are in feet, as their head says.",
        measures::feet,
    ),
    plain("position-false", "positions", Minor, "One position is far away.", measures::one_false_position)
        .of("metres", [3.0, 20.0, 500.0]),
    plain("positions-line", "positions", Note, "Positions lie on one line.", measures::on_a_line),
    // The capture as transforms.json.
    plain(
        "points-exchanged",
        "transforms",
        Serious,
        "The points' y and z are exchanged against the poses.",
        frames::exchanged_axes,
    ),
    plain(
        "points-turned",
        "transforms",
        Serious,
        "The points are turned by 180 degrees.",
        frames::turned_points,
    ),
    plain(
        "points-far-float",
        "transforms",
        Minor,
        "Points far from zero are stored with 32 bits.",
        frames::far_float_points,
    )
    .of("units from zero", [1e5, 1e6, 1e7]),
    plain(
        "camera-axes",
        "transforms",
        Serious,
        "Cameras have the axes of OpenCV in place of OpenGL's.",
        frames::other_camera_axes,
    ),
    plain("poses-inverse", "transforms", Serious, "Poses are from world to camera.", frames::inverse_poses),
    plain("json-nan", "transforms", Refused, "A position is NaN.", frames::nan),
    plain("json-mark", "transforms", Right, "The file begins with a byte order mark.", frames::mark),
    plain("json-comments", "transforms", Refused, "The file has a comment.", frames::comments),
    plain(
        "no-size",
        "transforms",
        Right,
        "The file has an angle in place of focal length and size, and names without endings.",
        frames::no_size,
    ),
    plain(
        "two-lists",
        "transforms",
        Note,
        "There are transforms_train.json and _test.json.",
        frames::two_lists,
    ),
    plain("crop-radius", "transforms", Note, "The file has a fisheye_crop_radius.", frames::crop_radius),
    plain(
        "unknown-fields",
        "transforms",
        Note,
        "The file has fields for crops and a shutter.",
        frames::unknown_fields,
    ),
    plain(
        "depth-named",
        "transforms",
        Note,
        "The file names metric depth maps, and they lie in depth/.",
        frames::named_depth,
    ),
];
