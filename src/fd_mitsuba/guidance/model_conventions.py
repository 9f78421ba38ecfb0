"""What a pipeline's weights were trained with: the optional `fd_mitsuba.json` beside `model_index.json`."""

from __future__ import annotations

import string
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.vocabulary import Vocabulary

FILE_NAME = "fd_mitsuba.json"
TEMPLATE_FIELDS = {"prompt", "view", "closeup"}


class ModelConventions(BaseModel):
    """Conventions of the weights; the defaults fit a stock Stable Diffusion model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    view_grid: Annotated[int, Field(ge=1, le=4)] = 1
    """Pictures are mosaics of view_grid x view_grid views, row by row from the top left, azimuths evenly spread."""
    views_together: Annotated[int, Field(ge=1, le=16)] | None = None
    """Consecutive views that a multi-view model sees at once; 4 where nothing is said. Not for other models."""
    normal_space: NormalSpace | None = None
    """Frame of the normals in the training pictures; None: the weights do not care."""
    needs_base: bool | None = None
    """If given, must agree with the UNet: 8 and 9 input channels take the base's picture as condition, 4 do not."""
    condition: Literal["base", "clay"] | None = None
    """What the condition picture shows: the base alone, or the part on it in grey clay. For people, not checked."""
    latents: Literal["vae", "area_mean_shine"] = "vae"
    """How colour pictures become latents: by the VAE, or by `colour_latents`, where shine is the fourth channel, and in
    the condition the part's coverage."""
    predicts: Literal["clean", "difference"] = "clean"
    """What a UNet with prediction type `sample` says: the clean latents, or what must be added to the condition's as
    the VAE gives them, without a scaling factor."""
    sees_region: bool = False
    """Whether a UNet with 9 input channels is told by the fifth where the part may be, and sees the base whole, which
    one pass of classifier-free guidance leaves out; else 9 channels are those of an inpainting model."""
    background: Literal["black", "white"] | None = None
    """Behind the objects of the training pictures, if always the same. For people, not checked."""
    prompt_template: str = "{prompt}, {closeup}, {view}"
    """Comma-separated items of {prompt}, {view}, {closeup} and fixed words; an item that comes out empty is dropped."""
    view_words: tuple[str, ...] = ()
    """One word per azimuth bin. Empty: "front view", "side view", "back view" for pictures, nothing for mosaics."""
    view_start_deg: float | None = None
    """Where bin 0 of `view_words` starts. Default: minus half a bin (centred on the front), but 0 for mosaics."""
    closeup_word: str = ""
    """What {closeup} becomes for views that are centred on the focal regions and close."""
    whole_words: bool = False
    """The tokenizer knows whole words only, so that a word it must split is one the model never saw."""
    vocabulary: Vocabulary | None = None
    """The words that the model knows, if they can be listed; a prompt that asks for no known part is refused."""
    draft_scale: Annotated[float, Field(ge=0)] = 3.0
    """Classifier-free guidance of the text where a part is drafted; a model that is less sure wants less."""
    about: dict[str, Any] = {}
    """Free remarks (training data, licence); not read."""

    @property
    def is_packed(self) -> bool:
        """Whether they were written for a prior of this package, which knows whole words."""
        return self.whole_words or self.vocabulary is not None

    @model_validator(mode="after")
    def _template_fields_exist(self) -> ModelConventions:
        fields = {name for _, name, _, _ in string.Formatter().parse(self.prompt_template) if name is not None}
        if "prompt" not in fields or not fields <= TEMPLATE_FIELDS:
            raise ValueError("prompt_template must use {prompt} and may use {view} and {closeup}")
        return self


def read_model_conventions(folder: Path) -> ModelConventions:
    """The conventions in `folder/fd_mitsuba.json`, or the defaults without that file.

    Raises:
        UserError: not JSON, an unknown key, a value of the wrong type.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return ModelConventions()
    try:
        return ModelConventions.model_validate_json(path.read_text(encoding="utf-8"))
    except ValidationError as error:
        problem = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"])
        raise UserError(f"{path}: {key + ': ' if key else ''}{problem['msg']}; mend or remove the file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error}); mend or remove the file") from None
