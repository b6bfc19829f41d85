"""Options of the `mtlnet` commands, in the order of the commands.

The options of `train`, `ablate` and `calibrate` are fields of their configurations.
"""

from pathlib import Path
from typing import Annotated

import typer

Model = Annotated[
    str,
    typer.Option(
        help='Model: a run\'s folder, its name in runs/, "latest", or a shipped model: "default", '
        'or "varied" for real roads and lanes of 2.8 to 4.3 m.'
    ),
]
EngineKind = Annotated[
    str, typer.Option("--engine", help="Engine: openvino, or torch (float32, for comparison).")
]
Precision = Annotated[
    str | None,
    typer.Option(
        help="Precision of the engine: int8 (after `mtlnet export`), bf16 or f32.",
        show_default="int8 if it passed its accuracy gate, else bf16 if the CPU has it, else f32",
    ),
]
Views = Annotated[
    int,
    typer.Option(
        help="Number of views of each image whose answers are averaged: 1; 2 (and mirrored: errors "
        "a tenth smaller); 6 (and turned left and right). The time is proportional to it."
    ),
]

# Options of `train`, beside the fields of TrainConfig.
Heads = Annotated[
    str | None,
    typer.Option(
        help="Output heads: bins (distributions) or coded (the paper's numbers).",
        show_default="the network's",
    ),
]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume", help="Continue the stopped run in --out; without --out, the newest run."
    ),
]

# Options of `ablate`, beside the fields of AblationConfig.
Backbone = Annotated[
    str, typer.Option(help="Network to compare with: mobilenet_v3_small or regnet_y_400mf.")
]
Rows = Annotated[
    str,
    typer.Option(
        help="Rows of the table, separated by commas: distance, angle, type, mtl-1 to mtl-4, "
        "deepdriving, the backbone.",
        show_default="all",
    ),
]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Print the plan and its estimated duration; train nothing."),
]

# Options of `export`.
Format = Annotated[str, typer.Option("--format", help="Format to write: onnx or openvino.")]
ExportPrecision = Annotated[
    str,
    typer.Option(
        help="Precision of the weights: f32, bf16 (half the size) or int8 (openvino only)."
    ),
]
CheckData = Annotated[
    Path | None,
    typer.Option(help="Dataset whose frames check the export.", show_default="the training data"),
]
ExportOut = Annotated[
    Path | None,
    typer.Option(help="Folder to write.", show_default="RUN/export/FORMAT-PRECISION"),
]
CheckFrames = Annotated[
    int,
    typer.Option(help="Number of frames on which the export is compared with torch, 1 to 10,000."),
]

# Options of `ship`.
ShipOut = Annotated[Path, typer.Option(help="Folder of the shipped model.")]
RefitData = Annotated[
    Path | None,
    typer.Option(
        help="Dataset that the model was not trained on; the standard deviations and the "
        "out-of-distribution limit are fitted again on its train rounds.",
        show_default="none: as fitted in training",
    ),
]
ShippedEvaluations = Annotated[
    list[Path] | None,
    typer.Option(
        help="File with the output of `mtlnet evaluate --json`, whose figures README.md shows; may "
        "be given several times.",
        show_default="none",
    ),
]
ShippedNotes = Annotated[
    Path | None,
    typer.Option(
        help="Markdown file to include in README.md, for example the commands of the training.",
        exists=True,
        show_default="none",
    ),
]
ShippedPicture = Annotated[
    Path | None,
    typer.Option(
        help="JPEG of `mtlnet evaluate --worst` to show in README.md.",
        exists=True,
        show_default="none",
    ),
]

# Options of `evaluate`.
EvaluationData = Annotated[
    Path,
    typer.Option(help="Dataset folder, or a folder of images with a labels.csv (and camera.yaml)."),
]
Split = Annotated[str, typer.Option(help="Rounds to evaluate on: train, test, unseen or all.")]
Protocol = Annotated[
    str,
    typer.Option(
        help="paper: evaluate as the paper does, on the rounds of `datagen protocol`, and show the "
        "paper's figures too.",
        show_default="none",
    ),
]
ReportPage = Annotated[
    Path | None,
    typer.Option("--report", help="HTML page to write: a file or a folder.", show_default="none"),
]
WorstSheet = Annotated[
    Path | None,
    typer.Option(
        "--worst", help="JPEG to write: the frames with the largest errors.", show_default="none"
    ),
]
EveryFrame = Annotated[int, typer.Option(help="Evaluate only every n-th frame.")]
Copies = Annotated[
    str,
    typer.Option(
        help="Evaluate also changed copies of each picture of labels.csv, separated by commas: "
        "mirrored (one copy), turned (two copies, the camera turned by 0.06 rad to the left and to "
        "the right).",
        show_default="none",
    ),
]

# Options of `predict`.
PredictInputs = Annotated[
    list[str],
    typer.Argument(
        help="Images, films, rounds, Foxglove files, ROS 2 bags, folders or patterns of them; a "
        "webcam by its number; a stream by its address (rtsp://, http://)."
    ),
]
PredictOut = Annotated[
    list[Path] | None,
    typer.Option(
        help="Table (.csv, .jsonl), film (.mp4), Foxglove file (.mcap) or folder of pictures to "
        "write; may be given several times.",
        show_default="none",
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(
        help="Vertical field of view of images and films, degrees.", show_default="the model's"
    ),
]
PredictCamera = Annotated[
    Path | None,
    typer.Option(
        help="Camera file (YAML) of the pictures, or `model` for the model's camera.",
        show_default="a recording's own; estimated from a film or stream; else the model's",
    ),
]
Topic = Annotated[
    str,
    typer.Option(
        help="Topic of a Foxglove file or ROS 2 bag that holds the pictures.",
        show_default="the only topic with pictures",
    ),
]

# Options of `label`.
LabelFolderName = Annotated[
    Path,
    typer.Argument(metavar="FOLDER", help="Folder of the pictures; labels.csv is written there."),
]
LabelCamera = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="Camera file of the pictures; it is copied to FOLDER/camera.yaml.",
        show_default="FOLDER/camera.yaml",
    ),
]
NoModel = Annotated[
    bool,
    typer.Option(
        "--no-model",
        help="Start with the car in the middle of a lane instead of with a model's answer.",
    ),
]
LabelHost = Annotated[
    str,
    typer.Option(
        "--host",
        help="Address to listen on. An address that other machines can reach requires a token.",
    ),
]
LabelPort = Annotated[
    int, typer.Option("--port", help="Port to listen on; 0: any free port.", min=0, max=65535)
]
LabelToken = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        help="File that contains the token; the labelling page then asks for it.",
        show_default="$DRIVERVIEW_TOKEN",
    ),
]
LabelInsecure = Annotated[
    bool,
    typer.Option(
        "--insecure", help="Require no token, even on a --host that other machines can reach."
    ),
]
ImportTable = Annotated[
    Path | None,
    typer.Option(
        "--import",
        help="Table of labels to convert, with x_left_m, x_right_m, heading_rad, ...",
        show_default="none",
    ),
]
LabelStdGiven = Annotated[
    list[str] | None,
    typer.Option(
        "--label-std",
        help="With --import: standard deviation of the labels as METRES,RADIANS, or "
        "PATTERN=METRES,RADIANS for the files that match; may be given several times.",
        show_default="none",
    ),
]
