"""The options of the `mtlnet` commands, in the order of the commands that have them."""

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
MODEL_HELP = 'Run folder, name in runs/, "latest", or "default" (the weights shipped).'
Model = Annotated[str, typer.Option(help=MODEL_HELP)]
EngineKind = Annotated[
    str, typer.Option("--engine", help="openvino, or torch (float32, for comparison).")
]
Precision = Annotated[
    str | None,
    typer.Option(
        help="int8 (after `mtlnet export`), bf16 or f32.  [default: int8 once it passed its gate, "
        "else bf16 where the CPU computes in it]"
    ),
]
Data = Annotated[Path, typer.Option(help="Dataset folder.")]
EvaluationData = Annotated[
    Path,
    typer.Option(help="Dataset folder, or one with images, labels.csv and perhaps camera.yaml."),
]

# Options of `train`: None is the default of TrainConfig, or with --resume what the run has stored.
TrainData = Annotated[
    Path | None, typer.Option(help="Dataset folder.  [default: datasets/default]")
]
TrainOut = Annotated[Path | None, typer.Option(help="New run folder.  [default: runs/DATE-RECIPE]")]
Alpha = Annotated[
    str | None,
    typer.Option(
        help="Weights of the distance, angle and heading losses.  "
        "[default: the network's, 0.3,0.2,0.5 for grid and mtl]"
    ),
]
Network = Annotated[
    str | None,
    typer.Option(
        help="grid, grid_residual, mtl (the paper's), deepdriving, mobilenet_v3_small, "
        "regnet_y_400mf.  "
        "[default: grid, with recipe paper mtl]"
    ),
]
Heads = Annotated[
    str | None,
    typer.Option(
        help="bins (distributions) or coded (the paper's numbers).  [default: the network's]"
    ),
]
Balance = Annotated[
    str | None,
    typer.Option(
        help="Task weights: fixed (alpha), or found by uncertainty or dwa.  [default: fixed]"
    ),
]
Init = Annotated[
    str | None,
    typer.Option(
        help='Model to start from, "default" or a run; --data may then be images with labels.csv.'
    ),
]
TrainRecipe = Annotated[
    str | None,
    typer.Option(
        help="fast (minutes), paper (days), or with --init tune (to fine-tune) or continue "
        "(hours on new frames).  "
        "[default: fast, with --init tune]"
    ),
]
TrainIterations = Annotated[
    int | None, typer.Option(help="Steps.  [default: the recipe's, unless --minutes is given]")
]
Minutes = Annotated[
    float | None,
    typer.Option(help="Duration of the training; the learning rate follows the time elapsed."),
]
Seed = Annotated[int | None, typer.Option(help="Seed of all random numbers.  [default: 0]")]
TrainBatch = Annotated[int | None, typer.Option(help="Images a step.  [default: the recipe's]")]
TrainDevice = Annotated[
    str | None, typer.Option(help="auto, cpu, cuda or cuda:NUMBER.  [default: auto]")
]
TrainThreads = Annotated[int | None, typer.Option(help="CPU threads.  [default: one a core]")]
SkipUndecodable = Annotated[
    bool, typer.Option("--skip-undecodable", help="Omit images that cannot be decoded.")
]
HoldOutDrives = Annotated[
    str | None,
    typer.Option(
        help="Drives of labels.csv to leave out, with commas between them: `evaluate` then shows "
        "them apart."
    ),
]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Continue the stopped run in --out, or else the newest run."),
]
ChangeData = Annotated[
    bool, typer.Option("--change-data", help="With --resume: continue on another dataset.")
]

# Options of `ablate`.
AblationOut = Annotated[
    Path, typer.Option(help="Folder of the ablation; the same folder continues it.")
]
Iterations = Annotated[int, typer.Option(help="Steps of every run.")]
Seeds = Annotated[str, typer.Option(help="Every row is trained with each of them.")]
Recipe = Annotated[str, typer.Option(help="fast or paper.")]
Backbone = Annotated[
    str, typer.Option(help="Network to compare with: mobilenet_v3_small or regnet_y_400mf.")
]
Rows = Annotated[
    str,
    typer.Option(help="Rows: distance, angle, type, mtl-1 to mtl-4, deepdriving, the backbone."),
]
Batch = Annotated[int, typer.Option(help="Images a step.")]
AblationSplit = Annotated[str, typer.Option(help="Rounds to evaluate on: test or unseen.")]
Every = Annotated[int, typer.Option(help="Evaluate every n-th frame only.", min=1)]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:NUMBER.")]
Threads = Annotated[int, typer.Option(help="CPU threads; 0: one a core.")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print the plan and its estimated duration.")
]

# Options of `export` and `evaluate`.
Format = Annotated[str, typer.Option("--format", help="onnx or openvino.")]
ExportPrecision = Annotated[
    str, typer.Option(help="f32, bf16 (weights in half the bytes) or int8 (openvino).")
]
CheckData = Annotated[
    Path | None,
    typer.Option(help="Dataset to check the export on.  [default: the training data]"),
]
ExportOut = Annotated[
    Path | None, typer.Option(help="Folder.  [default: RUN/export/FORMAT-PRECISION]")
]
CheckFrames = Annotated[
    int, typer.Option(help="Frames, at most 10,000, on which the export is compared with torch.")
]
Split = Annotated[str, typer.Option(help="train, test, unseen or all.")]
ReportPage = Annotated[
    Path | None, typer.Option("--report", help="HTML page to write: a file, or a folder.")
]
Protocol = Annotated[
    str,
    typer.Option(
        help="paper: judge as the paper does, on rounds of `datagen protocol`, beside the paper's "
        "figures."
    ),
]
EveryFrame = Annotated[int, typer.Option(help="Evaluate every n-th frame only.")]
Copies = Annotated[
    str,
    typer.Option(
        help="Judge each picture of labels.csv also as copies: mirrored, turned (by 0.06 rad to "
        "either side), or both with a comma between them."
    ),
]
WorstSheet = Annotated[
    Path | None, typer.Option("--worst", help="JPEG to write: the frames of the largest errors.")
]
ShippedPicture = Annotated[
    Path | None, typer.Option(help="JPEG for README.md, of `mtlnet evaluate --worst`.", exists=True)
]
ShipOut = Annotated[Path, typer.Option(help="Folder for the model.")]
RefitData = Annotated[
    Path | None,
    typer.Option(
        help="Dataset that the model was not trained on: its train rounds set the standard "
        "deviations and the limit of out_of_distribution anew."
    ),
]
ShippedEvaluations = Annotated[
    list[Path] | None,
    typer.Option(help="Output of `mtlnet evaluate --json`, for README.md; several times."),
]
ShippedNotes = Annotated[
    Path | None, typer.Option(help="Markdown for README.md, such as the commands.", exists=True)
]
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
        help="Table (.csv, .jsonl), film (.mp4), Foxglove file (.mcap) or folder of pictures with "
        "the markings drawn in; may be given several times."
    ),
]
Topic = Annotated[
    str,
    typer.Option(help="Of a Foxglove file or ROS 2 bag.  [default: the only one with pictures]"),
]
PredictCamera = Annotated[
    Path | None,
    typer.Option(
        help="YAML file with the camera of the pictures, or `model`: they are as the model's.  "
        "[default: what a recording states or a film or stream shows, else the model's]"
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(help="Vertical field of view of images and films, degrees.  [default: model's]"),
]

# Options of `calibrate`.
CalibrateInputs = Annotated[
    list[str],
    typer.Argument(help="A film of a drive, or pictures of a board (files, folders, patterns)."),
]
CalibrateOut = Annotated[Path, typer.Option(help="Camera file to write.")]
Board = Annotated[
    str,
    typer.Option(
        help="Inner corners of the chessboard, as 9x6, or charuco:5x7:4X4_50:0.75 (squares, "
        "dictionary, marker's side in squares).  [default: a common chessboard]"
    ),
]
Fisheye = Annotated[bool, typer.Option("--fisheye", help="A fisheye lens (of a board).")]
Drive = Annotated[
    bool, typer.Option("--drive", help="The pictures are of a drive, in their order.")
]
LensFile = Annotated[
    Path | None, typer.Option("--camera", help="Camera file with the lens, as of a board.")
]
LensFieldOfView = Annotated[
    float | None,
    typer.Option(
        "--fov-y-deg",
        "--fov",
        help="Vertical field of view of film or pictures, degrees.  [default: 65 along the longer "
        "side, a guess]",
    ),
]
Photo = Annotated[
    Path | None, typer.Option(help="Photo of the same camera, whose EXIF states the focal length.")
]
LaneWidth = Annotated[
    float | None, typer.Option(help="Width of the lane driven in, m.  [default: 3.6, assumed]")
]
CalibrationPage = Annotated[
    Path | None, typer.Option("--report", help="HTML page to write, with what was found drawn in.")
]
# Options of `label`.
LabelFolderName = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder with the pictures, and with labels.csv.")
]
LabelCamera = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        help="The pictures' camera; copied to FOLDER/camera.yaml.  [default: FOLDER/camera.yaml]",
    ),
]
NoModel = Annotated[
    bool, typer.Option("--no-model", help="Begin with the middle of a lane, not with an answer.")
]
LabelHost = Annotated[
    str, typer.Option("--host", help="Address to listen on; another than this machine's: a token.")
]
LabelPort = Annotated[
    int, typer.Option("--port", help="Port to listen on; 0: any free one.", min=0, max=65535)
]
LabelToken = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        help="File with the token that the page asks for.  [default: $DRIVERVIEW_TOKEN]",
    ),
]
LabelInsecure = Annotated[
    bool,
    typer.Option("--insecure", help="Allow a --host that other machines reach, without a token."),
]
ImportTable = Annotated[
    Path | None,
    typer.Option("--import", help="Table with x_left_m, x_right_m, heading_rad, ... to convert."),
]
LabelStdGiven = Annotated[
    list[str] | None,
    typer.Option(
        "--label-std",
        help="With --import: standard deviation of the labels, METRES,RADIANS or "
        "PATTERN=METRES,RADIANS of the files that match; may be given several times.",
    ),
]
