"""All questions, by name."""

from __future__ import annotations

from golden import augmentations, cameras, pictures, plans, psfs

QUESTIONS = {
    question.name: question
    for module in (psfs, pictures, cameras, plans, augmentations)
    for question in module.QUESTIONS
}
