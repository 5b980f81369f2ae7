"""What ``tog`` alone shows: the stages in order, and the commands to begin with."""

STAGES = (
    # name in the Diagram, what comes out of it, the options that change it
    ("camera", "one look: colour and depth", "--noise, --side-cameras"),
    ("cloud", "the things on the table", "--fuse, --look"),
    ("proposer", "many grasps on them", "--proposer"),
    ("feasibility", "those that the arm can carry out", ""),
    ("candidates", "a few that differ", "--k"),
    ("view_selector", "the view that shows them best", "--view"),
    ("selector", "the one that fits the task", "--selector, --vlm"),
    ("trajectory", "a motion to it", ""),
    ("executor", "commands to arm and hand", ""),
)
COMMANDS = (
    ("tog demo", "one hammer, held for two tasks"),
    ('tog run --task "hand me the hammer"', "one simulated episode"),
    ("tog scenarios", "what else can be run"),
    ("tog eval Mug --seeds 2", "methods compared on the same trials"),
    ("tog doctor", "what this machine lacks"),
)


def overview() -> str:
    """Returns the page: at most 80 columns of ASCII, which every terminal can show."""
    lines = ["tog: training-free task-oriented grasping for the Franka Panda, in Drake.", ""]
    for i, (stage, result, options) in enumerate(STAGES):
        arrow = "" if i == 0 else "->"
        lines.append(f"  {arrow:<2} {stage:<14} {result:<33} {options}".rstrip())
    lines += ["", "Begin with:", ""]
    width = max(len(command) for command, _ in COMMANDS)
    lines += [f"  {command:<{width}}  {what}" for command, what in COMMANDS]
    lines += ["", "tog --help lists all commands; each has --help with an example."]
    return "\n".join(lines)
