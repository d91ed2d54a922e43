"""The main job: from a drawing to a moving robot."""

from sorojax.cli.demo.job import run as run
