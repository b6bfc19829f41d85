"""Options of the `mtlnet` commands, in the order of the commands.

The options of `train`, `ablate` and `calibrate` are fields of their configurations.
"""

from pathlib import Path
from typing import Annotated

import typer

Model = Annotated[
    str,
    typer.Option(
        help='Model: the folder of a training, its name in runs/, "latest" for the newest '
        'training, or a model that is shipped with the project: "default", or "varied" '
        "for real roads and lanes of 2.8 to 4.3 m."
    ),
]
EngineKind = Annotated[
    str,
    typer.Option(
        "--engine",
        help="Library that computes the answers: openvino, or torch (in float32, for comparison).",
    ),
]
Precision = Annotated[
    str | None,
    typer.Option(
        help="Precision in which OpenVINO computes: int8 (possible after `mtlnet export "
        "--precision int8`), bf16 or f32 (32-bit float). A CPU without bf16 computes in f32 "
        "instead of bf16.",
        show_default="int8 if the model has an int8 version that passed the accuracy gate of "
        "`mtlnet export` and is reliable on this CPU, else bf16 if the CPU supports it, else f32",
    ),
]

# Options of `train`, beside the fields of TrainConfig.
Heads = Annotated[
    str | None,
    typer.Option(
        help="Outputs of the network. bins: probabilities of the intervals into which the "
        "range of a value is divided; coded: one number for each value, as in the paper. "
        "Not with --init.",
        show_default="bins for grid and grid_residual, else coded",
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Continue the interrupted training in --out, or the newest training in runs/ if "
        "--out is not given. Only --iterations, --minutes, --device, --threads and "
        "--data (with --change-data) can be changed.",
    ),
]

# Options of `ablate`, beside the fields of AblationConfig.
Backbone = Annotated[
    str,
    typer.Option(
        help="Network of torchvision for the last row of the table: mobilenet_v3_small or "
        "regnet_y_400mf."
    ),
]
Rows = Annotated[
    str,
    typer.Option(
        help="Names of the rows to train, separated by commas: distance, angle, type (the "
        "paper's name of the class of the road), mtl-1, mtl-2, mtl-3, mtl-4, "
        "deepdriving, and the value of --backbone.",
        show_default="all",
    ),
]
DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Print the list of the trainings and their estimated duration; train nothing.",
    ),
]

# Options of `export`.
Format = Annotated[str, typer.Option("--format", help="Format to write: onnx or openvino.")]
ExportPrecision = Annotated[
    str,
    typer.Option(
        help="Precision: f32 (32-bit float), bf16 (weights of half the size) or int8 (with "
        "--format openvino only)."
    ),
]
CheckData = Annotated[
    Path | None,
    typer.Option(
        help="Dataset on whose frames the written model is compared with torch. For int8 it is "
        "also used to choose the scales of the integers (train rounds) and for the accuracy "
        "gate (test rounds).",
        show_default="the dataset of the training; required for a shipped model",
    ),
]
ExportOut = Annotated[
    Path | None,
    typer.Option(
        help="Folder to write. Not with int8, which is always written to the default.",
        show_default="export/FORMAT-PRECISION in the folder of the model",
    ),
]
CheckFrames = Annotated[
    int,
    typer.Option(
        help="Number of frames on which the written model is compared with torch, 1 to 10,000."
    ),
]
GateOnly = Annotated[
    bool,
    typer.Option(
        "--gate-only",
        help="Evaluate the accuracy gate of the int8 graph that the model has, on this processor, "
        "and write no graph. It is needed for processors of the other kind (with or without "
        "instructions for int8 numbers) than the one that exported the graph. With --precision "
        "int8 only.",
    ),
]

# Options of `ship`.
ShipOut = Annotated[Path, typer.Option(help="Folder to write the model to.")]
RefitData = Annotated[
    Path | None,
    typer.Option(
        help="Dataset that the model was not trained on. On its train rounds, the standard "
        "deviations that the model states with its answers, and the threshold for "
        "out-of-distribution images, are fitted again.",
        show_default="none: they stay as fitted in the training",
    ),
]
ShippedEvaluations = Annotated[
    list[Path] | None,
    typer.Option(
        help="File with the output of `mtlnet evaluate --json`, whose results are shown in "
        "README.md. Can be repeated.",
        show_default="none",
    ),
]
ShippedNotes = Annotated[
    Path | None,
    typer.Option(
        help="With --evaluation: Markdown file to include in README.md, for example the "
        "commands of the training.",
        exists=True,
        show_default="none",
    ),
]
ShippedPicture = Annotated[
    Path | None,
    typer.Option(
        help="With --evaluation: JPEG file of `mtlnet evaluate --worst` to show in README.md.",
        exists=True,
        show_default="none",
    ),
]

# Options of `evaluate`.
EvaluationData = Annotated[
    Path,
    typer.Option(
        help="Folder of a dataset, or a folder of labelled images: with labels.csv and, unless "
        "the images are of the model's camera, camera.yaml."
    ),
]
Split = Annotated[
    str,
    typer.Option(
        help="Rounds of the dataset to evaluate on: train, test, unseen (tracks that are kept for "
        "tests) or all. Not for a folder with labels.csv, whose images are all evaluated."
    ),
]
Protocol = Annotated[
    str,
    typer.Option(
        help='paper: evaluate as Li et al. ("Reinforcement Learning and Deep Learning based '
        'Lateral Control for Autonomous Driving") do, on a dataset of `datagen protocol` '
        "as --data, and show the paper's figures, too. Not with --split, --report, "
        "--worst and --copies.",
        show_default="none",
    ),
]
ReportPage = Annotated[
    Path | None,
    typer.Option(
        "--report",
        help="HTML page to write: a file, or an existing folder for report.html in it.",
        show_default="none",
    ),
]
WorstSheet = Annotated[
    Path | None,
    typer.Option(
        "--worst",
        help="JPEG file to write with the frames that have the largest errors. Only for a dataset.",
        show_default="none",
    ),
]
EveryFrame = Annotated[
    int,
    typer.Option(
        help="Step between two evaluated frames or pictures: 1 evaluates all, 5 every fifth. All "
        "--copies of an evaluated picture are evaluated."
    ),
]
Copies = Annotated[
    str,
    typer.Option(
        help="Only for a folder with labels.csv: also evaluate changed copies of each image, "
        "by kind, separated by commas: mirrored (one copy), turned (two copies, with the "
        "camera turned by 0.06 rad to the left and to the right).",
        show_default="none",
    ),
]

# Options of `predict`.
PredictInputs = Annotated[
    list[str],
    typer.Argument(
        help="Images, films, rounds, Foxglove files, ROS 2 bags, or folders or wildcard "
        "patterns (such as 'drive/*.jpg') of them; a webcam by its number; a stream by "
        "its address (rtsp://, http://)."
    ),
]
PredictOut = Annotated[
    list[Path] | None,
    typer.Option(
        help="File to write with the answers: table (.csv, .jsonl), film (.mp4), Foxglove "
        "file (.mcap), or a folder for pictures. Can be repeated.",
        show_default="none",
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(
        help="Vertical field of view of the images and films, degrees, above 0 and below 180. "
        "Not with the file of --camera, which states it.",
        show_default="stated in a Foxglove file or ROS 2 bag; estimated from a film or stream; "
        "else the model's",
    ),
]
PredictCamera = Annotated[
    Path | None,
    typer.Option(
        help="Camera file (YAML) of the camera that took the images; or `model` if it was the "
        "model's camera.",
        show_default="the camera stated in a Foxglove file or ROS 2 bag; for a film or stream, "
        "estimated from its images; else the model's",
    ),
]
Topic = Annotated[
    str,
    typer.Option(
        help="Topic with the images in a Foxglove file or ROS 2 bag.",
        show_default="the topic with images, if there is only one",
    ),
]

# Options of `label`.
LabelFolderName = Annotated[
    Path,
    typer.Argument(
        metavar="FOLDER", help="Folder of the pictures; the labels are written to labels.csv in it."
    ),
]
LabelCamera = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Camera file of the pictures. It is copied to FOLDER/camera.yaml. Not with --import.",
        show_default="FOLDER/camera.yaml",
    ),
]
NoModel = Annotated[
    bool,
    typer.Option(
        "--no-model",
        help="Run no model. The page then starts a picture without a label with the markings of "
        "a lane of usual width with the car in its middle, instead of the model's answer.",
    ),
]
LabelHost = Annotated[
    str,
    typer.Option(
        "--host",
        help="Address on which the page is served. An address that other machines can reach "
        "requires a token.",
    ),
]
LabelPort = Annotated[
    int, typer.Option("--port", help="Port of the page; 0: any free port.", min=0, max=65535)
]
LabelToken = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        help="File with the token (at least 16 characters), for which the page then asks.",
        show_default="the token in $DRIVERVIEW_TOKEN; if it is empty, no token is required",
    ),
]
LabelInsecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Allow that no token is set although other machines can reach --host.",
    ),
]
ImportTable = Annotated[
    Path | None,
    typer.Option(
        "--import",
        help="CSV file with labels to convert. Required columns: file, x_left_m, x_right_m "
        "(positions of the markings, left positive), heading_rad (angle to the road, "
        "right positive), fov_y_deg, camera_height_m.",
        show_default="none",
    ),
]
LabelStdGiven = Annotated[
    list[str] | None,
    typer.Option(
        "--label-std",
        help="With --import: standard deviations of the labelled distances (m) and angles "
        "(rad) as METRES,RADIANS for all files, or as PATTERN=METRES,RADIANS for the "
        "files whose path or name matches the wildcard PATTERN. Can be repeated; the last match "
        "counts.",
        show_default="none",
    ),
]
